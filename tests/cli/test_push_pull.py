"""`manip-il push` and `manip-il pull`: what they say, and their exit codes."""

from pathlib import Path

import pytest

from manip_il.cli.main import main


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "config.yaml").write_text("# manip-il\n")
    (folder / "metrics.jsonl").write_bytes(b"x" * 1500)
    return folder


@pytest.fixture
def url(tmp_path: Path) -> str:
    return f"file://{tmp_path}/store"


def test_there_and_back_and_again_nothing_travels(run, url, tmp_path, capsys):
    assert main(["push", str(run), url]) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"{url}: 2 files, 1.5 kB, uploaded; 0 removed",
        f"next: manip-il pull {url} FOLDER",
    ]
    target = tmp_path / "got"
    assert main(["pull", url, str(target), "--quiet"]) == 0
    captured = capsys.readouterr()
    assert captured.out == f"{target}: a policy of 2 files, 1.5 kB, all verified\n"
    assert captured.err == ""
    assert (target / "metrics.jsonl").read_bytes() == b"x" * 1500
    assert main(["push", str(run), url]) == 0
    assert (
        capsys.readouterr().out.splitlines()[0] == f"{url}: 0 files, 0 bytes, uploaded; 0 removed"
    )


def test_dry_runs_only_say(run, url, tmp_path, capsys):
    assert main(["push", str(run), url, "--dry_run"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "upload   config.yaml",
        "upload   metrics.jsonl",
        f"{url}: 2 files, 1.5 kB, would be uploaded; 0 would be removed",
    ]
    assert not (tmp_path / "store").exists()
    main(["push", str(run), url])
    capsys.readouterr()
    assert main(["pull", url, str(tmp_path / "got"), "--dry_run=true"]) == 0
    assert (
        capsys.readouterr()
        .out.splitlines()[-1]
        .endswith("a policy of 2 files, 1.5 kB, would be downloaded")
    )
    assert not (tmp_path / "got").exists()


def test_a_folder_that_is_there_is_replaced_only_when_asked_and_ours(run, url, tmp_path, capsys):
    main(["push", str(run), url])
    target = tmp_path / "got"
    target.mkdir()
    (target / "thesis.txt").write_text("mine")
    for asked, says in (
        ("false", "--overwrite=true replaces it"),
        ("true", "manip-il did not make"),
    ):
        assert main(["pull", url, str(target), f"--overwrite={asked}"]) == 2
        assert says in capsys.readouterr().err
    assert (target / "thesis.txt").read_text() == "mine"
    (target / "config.yaml").write_text("# manip-il 0.1.0: resolved options (TrainOptions)\n")
    assert main(["pull", url, str(target), "--overwrite=true"]) == 0
    assert not (target / "thesis.txt").exists()


def test_a_traceback_of_any_error_is_cleaned(run, url, monkeypatch, capsys):
    def fail(words: object):
        raise RuntimeError(
            "PUT https://store/x?X-Amz-Signature=0123456789abcdef with Authorization: Bearer"
            " hf_HunterTwo"
        )

    monkeypatch.setattr("manip_il.cli.run.transfer.run_push", fail)
    assert main(["push", str(run), url, "--debug"]) == 1
    error = capsys.readouterr().err
    assert "RuntimeError: PUT https://store/x?X-Amz-Signature=[hidden]" in error
    assert "0123456789abcdef" not in error
    assert "HunterTwo" not in error
