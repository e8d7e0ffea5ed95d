"""`manip-il theory` writes its page and its file; a folder that is no run is one line."""

import json
from functools import partial

import pytest

from manip_il.cli.main import main
from manip_il.theory.bounds import all_curves

RUN = ["dagger", "--robot.type=panda", "--task.type=reach", "--demonstrations=4", "--rounds=1"]
QUICK = ["--env.horizon=60", "--episodes_per_round=2", "--validation_episodes=2", "--steps=60", "--workers=1"]


@pytest.mark.slow
def test_the_page_shows_the_theorems_and_the_run(tmp_path, capsys, monkeypatch):
    # the documented command computes all of them
    monkeypatch.setattr("manip_il.theory.bounds.all_curves", partial(all_curves, (10, 40, 160), 12))
    run, folder = tmp_path / "run", tmp_path / "theory"
    assert main([*RUN, *QUICK, f"--output_dir={run}"]) == 0
    words = ["theory", str(run), "--episodes=3", "--cases=2", "--workers=1", f"--output_dir={folder}"]
    assert main(words) == 0
    out, _ = capsys.readouterr()
    found = json.loads((folder / "theory.json").read_text())
    assert found["above"] == 0
    assert "policies above their bound: 0" in out
    shift = found["shift"]
    assert (shift["robot"], shift["task"], len(shift["rounds"])) == ("panda", "reach", 2)
    assert shift["horizon"] == 60  # the run's own
    for one in shift["rounds"]:
        assert one["bound"] == pytest.approx(shift["u"] * one["mistakes"])
        assert one["gap"] == pytest.approx(one["cost"] - shift["expert_cost"])
        assert 0 <= one["on_expert"] <= 1
    page = (folder / "report.html").read_text()
    assert page.count("data:image/svg+xml;base64,") == 3
    assert "Theorem 8.1" in page
    assert "panda reach" in page
    assert main(words) == 2  # it is there already


def test_what_is_no_run_is_one_line(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    assert main(["theory", str(tmp_path / "empty"), f"--output_dir={tmp_path / 't'}"]) == 1
    assert "has no round with a policy" in capsys.readouterr().err.splitlines()[-1]
