"""What is read off the text of configuration files is what importing them gives."""

from __future__ import annotations

from dataclasses import fields

import pytest

from manip_il.errors import UnknownName
from manip_il.learn.choices import policy_class, policy_types
from manip_il.learn.policy_names import NOT_OURS, check_names, policy_files, policy_options


def test_the_policies_are_those_that_lerobot_registers():
    assert tuple(sorted(policy_files())) == policy_types()


@pytest.mark.parametrize("kind", policy_files())
def test_a_policys_options_are_the_fields_of_its_class(kind: str):
    wanted = {one.name for one in fields(policy_class(kind)) if one.init and one.name not in NOT_OURS}
    assert set(policy_options(kind)) == wanted


def test_a_name_that_is_not_there_is_refused_with_the_nearest():
    with pytest.raises(UnknownName, match=r"unknown policy 'atc' \(did you mean 'act'\?\)"):
        check_names({"type": "atc"}, "mlp")
    with pytest.raises(
        UnknownName, match=r"'chunksize' \(did you mean 'chunk_size'\?\); manip-il train --policy\.type=act"
    ):
        check_names({"type": "act", "chunksize": 3}, "mlp")
    check_names({"type": "act", "chunk_size": 3}, "mlp")
    check_names({"path": "runs/x", "chunk_sice": 3}, "mlp")  # whose type only the checkpoint knows
