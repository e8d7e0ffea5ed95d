import importlib
import pickle
import re
import sys

import pytest

from manip_il.cli.main import main
from manip_il.cli.outputs import say
from manip_il.errors import ManipError, UnknownName, nearest, requires, shorten, warn
from manip_il.evaluation.report import Table


def test_a_near_name_is_offered_and_all_are_listed():
    near, far = (
        str(UnknownName("robot", name, ["panda", "fetch"])) for name in ("pnada", "xylophone")
    )
    assert near == "unknown robot 'pnada' (did you mean 'panda'?); known: fetch, panda"
    assert far == "unknown robot 'xylophone'; known: fetch, panda"
    assert nearest("lfit", iter(["reach", "lift"])) == " (did you mean 'lift'?)"


def test_no_control_character_of_a_name_reaches_a_terminal(capsys: pytest.CaptureFixture[str]):
    name = "\x1b[31mred\x07\x9b\udcff"
    error = UnknownName("body", "hand", [name])
    assert "known: \\x1b[31mred\\x07\\x9b\\udcff" in str(error)
    main(["--help"])  # which prints warnings from here on
    for write in (say, warn, lambda line: Table(("joint",), ((line,),)).print()):
        write(name)
    assert main(["data", name]) == main(["robot", "check", f"{name}.yaml"]) == 2
    assert not {"\x1b", "\x07", "\x9b", "\udcff"} & set("".join(capsys.readouterr()))
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_a_huge_structure_is_not_printed_as_a_whole():
    value: object = "x"
    for _ in range(60):  # 9^60 values
        value = {"a": [value] * 9}
    assert len(shorten(value)) <= 200


def test_a_missing_package_is_one_line_that_says_what_to_type(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "ray", None)  # as if it were not installed
    monkeypatch.delitem(sys.modules, "manip_il.collect.ray_pool", raising=False)
    line = "--engine=ray needs ray, which is not installed: pip install 'manip_il[ray]'"
    with pytest.raises(ManipError, match=re.escape(line)):
        importlib.import_module("manip_il.collect.ray_pool")
    with pytest.raises(ValueError, match="own"), requires("a policy", "torch"):
        raise ValueError("other errors are told as they are: our own")
