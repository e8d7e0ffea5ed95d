"""`manip-il eval --check` says in one line what there is, or what is missing."""

from __future__ import annotations

import re

import pytest

from manip_il.cli.main import main


@pytest.mark.gl
def test_a_healthy_machine_says_what_it_has(capsys):
    assert main(["eval", "--check"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert re.fullmatch(r"healthy: \S.*; cores [1-9]\d*\n", out)
