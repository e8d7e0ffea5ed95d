"""A disk that fills up under a command: one line that names the path; with more room the command goes on."""

from __future__ import annotations

from pathlib import Path

import pytest

from manip_il.cli.main import main

from ..cli.made_runs import make_eval
from .full_disk import small_disk, the_error

SAMPLE = Path(__file__).parents[2] / "datasets" / "sample"
REACH = ("--robot.type=fetch", "--task.type=reach", "--workers=1")

TRAIN = ("train", f"--dataset.root={SAMPLE}", "--steps=4", "--save_freq=2", "--policy.width=64")
DAGGER = (
    *("dagger", *REACH, "--rounds=1", "--demonstrations=2", "--episodes_per_round=2", "--validation_episodes=1"),
    *("--steps=4", "--policy.width=64"),
)
EVAL = ("eval", "--policy.type=expert", *REACH, "--eval.n_episodes=6", "--eval.films=0")


def make_evals(folder: Path) -> None:
    """`left/eval.json`, `right/eval.json` of another policy on the same seeds, `more/eval.json` of left's on others."""
    make_eval(folder / "left" / "eval.json", [True, False, True])
    make_eval(folder / "right" / "eval.json", [True, True, False])
    make_eval(folder / "more" / "eval.json", [True, True, False], seed=4_001_000)
    for name in ("left", "more"):
        path = folder / name / "eval.json"
        path.write_text(path.read_text().replace(f'"policy": "{name}"', '"policy": "expert"'))


def error_of(words: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> str:
    """The error of a command that fails."""
    capsys.readouterr()
    assert main([*words, "--quiet"]) == 1
    return the_error(capsys.readouterr().err)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "size", "place"),
    [
        pytest.param(TRAIN, 60_000, "out/checkpoints/", id="train"),
        pytest.param(DAGGER, 20_000, "out/round_000/journals/", id="dagger journals"),
        pytest.param(DAGGER, 130_000, "out/round_000/", id="dagger"),
        pytest.param(EVAL, 12_288, "out/", id="eval"),
    ],
)
def test_what_was_finished_is_kept_and_the_command_goes_on(words, size, place, tmp_path, capsys):
    with small_disk(tmp_path / "disk", size) as disk:
        out = disk.folder / "out"
        line = error_of((*words, f"--output_dir={out}"), capsys)
        assert f"cannot write {disk.folder}/{place}" in line
        assert ("No space left on device" if disk.is_real else "File too large") in line
        assert "kept: " in line
        assert "--resume=true" in line
        assert not list(disk.folder.rglob("*.partial")) + list(disk.folder.rglob("*.tmp"))
        disk.grow()
        assert main([*words, f"--output_dir={out}", "--resume=true", "--quiet"]) == 0


@pytest.mark.parametrize("words", [("merge", "left", "more"), ("compare", "left", "right")])
def test_evaluations_are_merged_and_compared_anew(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    make_evals(tmp_path)
    with small_disk(tmp_path / "disk", 8_192) as disk:
        out = disk.folder / "out"
        line = error_of((*words, f"--output_dir={out}"), capsys)
        assert f"cannot write {out}/" in line
        disk.grow()
        assert main([*words, f"--output_dir={out}", "--overwrite=true", "--quiet"]) == 0


def test_an_export_leaves_nothing_behind(tmp_path, capsys):
    with small_disk(tmp_path / "disk", 8_192) as disk:
        out = disk.folder / "out"
        line = error_of(("mcap", "export", str(SAMPLE), str(out)), capsys)
        assert f"cannot write {out}: " in line
        assert list(disk.folder.iterdir()) == []


@pytest.mark.parametrize(
    "words", [("merge", "left", "more", "--output_dir=file/out"), ("mcap", "export", str(SAMPLE), "file/out")]
)
def test_a_path_through_a_file_is_named(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    make_evals(tmp_path)
    Path("file").write_text("")
    assert "file" in error_of(words, capsys)
    assert Path("file").read_text() == ""
