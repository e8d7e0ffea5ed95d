import pytest

from manip_il.errors import (
    FolderExistsError,
    ManipError,
    MismatchError,
    NotFiniteError,
    RenderError,
    UnknownName,
    UsageError,
    nearest,
)


def test_a_near_name_is_offered_and_all_are_listed():
    near, far = (str(UnknownName("robot", name, ["panda", "fetch"])) for name in ("pnada", "xylophone"))
    assert near == "unknown robot 'pnada' (did you mean 'panda'?); known: fetch, panda"
    assert far == "unknown robot 'xylophone'; known: fetch, panda"
    assert nearest("lfit", iter(["reach", "lift"])) == " (did you mean 'lift'?)"


def test_a_mismatch_names_both_sides():
    message = str(MismatchError("fps", "the dataset", 20, "the policy", 25))
    assert message == "fps differs: the dataset has 20, the policy has 25"


@pytest.mark.parametrize(
    ("code", "kinds"),
    [(1, (ManipError, MismatchError, NotFiniteError, RenderError)), (2, (UsageError, UnknownName, FolderExistsError))],
)
def test_failed_work_exits_1_and_wrong_words_exit_2(code: int, kinds: tuple[type[ManipError], ...]):
    assert {kind.exit_code for kind in kinds} == {code}
