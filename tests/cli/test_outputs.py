"""Output folders: what a kill leaves, what may be overwritten, and one command at a time."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from manip_il.cli.imitation import DatasetGroup, RecordOptions, SourceGroup, TrainOptions
from manip_il.cli.main import main
from manip_il.cli.outputs import (
    CONFIG_FILE,
    OutputFile,
    check_same_options,
    prepare_output,
    save_options,
)
from manip_il.cli.parsing import CONFIG_HEADER
from manip_il.data.atomic import DATASET, EPISODES, exclusive, output_of, write_file
from manip_il.data.lerobot_layout import OURS
from manip_il.errors import FolderExistsError, MismatchError, UsageError

from .made_runs import files, run

SAMPLE = Path(__file__).parents[2] / "datasets" / "sample"
EVALUATION = output_of("Eval")


@pytest.fixture
def ours(tmp_path):
    folder = tmp_path / "run"
    write_file(
        folder / "config.yaml", f"{CONFIG_HEADER} 0: resolved options (EvalOptions)\n".encode()
    )
    return folder


def overwrite(folder: Path, kind: str = EVALUATION) -> None:
    prepare_output({folder: kind}, overwrite=True)


def test_a_new_or_empty_folder_is_fine_and_a_full_one_is_refused_with_the_ways_on(ours, tmp_path):
    prepare_output({tmp_path / "new": EVALUATION})
    prepare_output({tmp_path / "new": EVALUATION}, resume=True)
    (tmp_path / "empty").mkdir()
    prepare_output({tmp_path / "empty": EVALUATION})
    with pytest.raises(FolderExistsError, match=r"--resume=true.*--overwrite=true"):
        prepare_output({ours: EVALUATION})
    prepare_output({ours: EVALUATION}, resume=True, overwrite=True)
    assert (ours / "config.yaml").is_file()


def test_resume_removes_what_a_killed_writer_left_of_a_file(ours):
    (ours / ".fingerprint.json.x.partial").touch()
    prepare_output({ours: EVALUATION}, resume=True)
    assert [path.name for path in ours.iterdir()] == ["config.yaml"]


def test_a_run_that_was_killed_before_it_wrote_its_options_can_be_gone_on_with(tmp_path):
    options = RecordOptions(dataset=DatasetGroup(root=tmp_path / "demos"))
    (tmp_path / f".{CONFIG_FILE}.123.tmp").write_text("# manip-")
    check_same_options(tmp_path, options)
    (tmp_path / "episode.mcap").touch()
    with pytest.raises(UsageError, match=r"cannot read .*config\.yaml"):
        check_same_options(tmp_path, options)


@pytest.mark.parametrize(
    ("name", "content", "kind"),
    [
        (
            "config.yaml",
            f"{CONFIG_HEADER} 0.1.0: resolved options (EvalOptions)\nseed: 0\n",
            EVALUATION,
        ),
        (
            "config.yaml",
            f"{CONFIG_HEADER} 0.1.0: resolved options (TrainOptions)\nseed: 0\n",
            output_of("Train"),
        ),
        (
            "config.yaml",
            f"{CONFIG_HEADER} 0.1.0: resolved options (RecordOptions)\nseed: 0\n",
            EPISODES,
        ),
        ("recording.json", json.dumps({"only_successes": True}), EPISODES),
        (
            "meta/info.json",
            json.dumps({"features": {"action": {}, "executed_action": {}, "sim_state": {}}}),
            DATASET,
        ),
        (OURS, json.dumps({"spec": {}, "fingerprint": {}}), DATASET),
        ("eval.json", json.dumps({"success_rate": 1.0, "fingerprint": {}}), EVALUATION),
        ("config.yaml", "seed: 0\n", None),
        ("thesis.tex", "years of work", None),
    ],
)
def test_overwrite_deletes_the_same_kind_that_this_program_made_and_nothing_else(
    tmp_path, name, content, kind
):
    write_file(tmp_path / "run" / name, content.encode())
    for other in {EVALUATION, DATASET, EPISODES, output_of("Train")} - {kind}:
        with pytest.raises(UsageError, match=kind or "did not make"):
            overwrite(tmp_path / "run", other)
        assert (tmp_path / "run" / name).read_text() == content
    if kind:
        inode = (tmp_path / "run").stat().st_ino
        overwrite(tmp_path / "run", kind)
        assert list((tmp_path / "run").iterdir()) == []
        assert (tmp_path / "run").stat().st_ino == inode, "it may be a mount point"


@pytest.mark.parametrize("name", ["a.onnx", "pairs.json", "ask.html", "replay.mp4"])
def test_overwrite_replaces_a_single_file_only_if_it_names_this_program(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(b"years of work")
    with pytest.raises(UsageError, match="does not say that manip-il wrote it"):
        OutputFile(output=path, overwrite=True).check()
    path.write_bytes(b'\x08{"format": "manip_il pairs"}')
    OutputFile(output=path, overwrite=True).check()
    with pytest.raises(UsageError, match="--overwrite=true"):
        OutputFile(output=path).check()


def test_an_evaluation_does_not_replace_a_dataset(tmp_path):
    root = shutil.copytree(SAMPLE, tmp_path / "demos")
    before = files(root)
    assert main([*EVAL, f"--output_dir={root}", "--overwrite=true"]) == 2
    assert files(root) == before


def test_nothing_is_deleted_in_a_folder_that_cannot_be_resumed(tmp_path):
    (tmp_path / "notes").touch()
    (tmp_path / ".film.partial").touch()
    assert main([*EVAL, f"--output_dir={tmp_path}", "--resume=true"]) == 2
    assert len([*tmp_path.iterdir()]) == 2


EVAL = ["eval", "--policy.type=expert", "--robot.type=fetch", "--task.type=reach", "--workers=1"]


def test_overwrite_spares_what_is_read_and_follows_no_link(ours, tmp_path):
    (tmp_path / "link").symlink_to(ours)
    with pytest.raises(UsageError, match="is a link"):
        overwrite(tmp_path / "link")
    assert (ours / "config.yaml").is_file()
    with pytest.raises(UsageError, match="overlaps"):
        prepare_output({ours: EVALUATION}, overwrite=True, sources=[ours / "inside"])
    (ours / "dagger").mkdir()
    assert run(f"data build {ours} {ours} --overwrite=true") == 2
    (ours / "mine.yaml").write_text("joint_noise: 0.1\n")
    assert (
        main([*EVAL, f"--suite={ours}/mine.yaml", f"--output_dir={ours}", "--overwrite=true"]) == 2
    )
    assert (ours / "dagger").is_dir()
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "main.tex").touch()
    (ours / "link").symlink_to(tmp_path / "thesis")
    overwrite(ours)
    assert list(ours.iterdir()) == []
    assert (tmp_path / "thesis" / "main.tex").exists()


@pytest.mark.parametrize("how", ["", "--overwrite=true"])
def test_a_folder_that_is_in_use_is_refused(how, here, error):
    out = here / "out"
    with exclusive(out):
        assert main([*EVAL, f"--output_dir={out}", *([how] if how else [])]) == 1
        assert error().endswith(
            f": {out} is in use by another process; wait until that is done, or choose another"
            " folder"
        )
    assert not out.exists()


def test_a_resumed_run_may_have_more_steps_but_no_fewer(tmp_path):
    save_options(
        tmp_path, resumed := TrainOptions(dataset=SourceGroup([tmp_path]), fit={"steps": 4})
    )
    check_same_options(tmp_path, replace(resumed, fit={"steps": 8}))
    for other in ({"steps": 2}, {}):
        with pytest.raises(MismatchError, match="--steps"):
            check_same_options(tmp_path, replace(resumed, fit=other))
