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
    message = str(UnknownName("robot", "pnada", ["panda", "fetch"]))
    assert message == "unknown robot 'pnada' (did you mean 'panda'?); known: fetch, panda"


def test_a_far_name_offers_none():
    message = str(UnknownName("robot", "xylophone", ["panda", "fetch"]))
    assert message == "unknown robot 'xylophone'; known: fetch, panda"


def test_nearest_takes_any_iterable():
    assert nearest("lfit", iter(["reach", "lift"])) == " (did you mean 'lift'?)"
    assert nearest("zzz", iter(["reach", "lift"])) == ""


def test_a_mismatch_names_both_sides():
    message = str(MismatchError("fps", "the dataset", 20, "the policy", 25))
    assert message == "fps differs: the dataset has 20, the policy has 25"


def test_an_existing_folder_says_what_to_do():
    assert "--resume=true" in str(FolderExistsError("runs/x"))
    assert "--overwrite=true" in str(FolderExistsError("runs/x"))


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (ManipError("x"), 1),
        (MismatchError("x", "a", 1, "b", 2), 1),
        (NotFiniteError("x"), 1),
        (RenderError("x"), 1),
        (UsageError("x"), 2),
        (UnknownName("x", "y", ["z"]), 2),
        (FolderExistsError("x"), 2),
    ],
)
def test_failed_work_exits_1_and_wrong_words_exit_2(error: ManipError, code: int):
    assert error.exit_code == code
