"""`manip-il robot certify` writes what it measured and prints it.

What cannot be is one line before the first step.
"""

import json

from manip_il.cli.main import main
from manip_il.worlds.table import env_fingerprint, make_config

ENV = make_config("fetch", "reach", horizon=60)
WORDS = [
    "robot",
    "certify",
    "--robot.type=fetch",
    "--task.type=reach",
    "--env.horizon=60",
    "--cases=2",
    "--workers=1",
]


def test_the_file_and_the_tables_say_the_same(tmp_path, capsys):
    folder = tmp_path / "c"
    assert main([*WORDS, f"--output_dir={folder}"]) == 0
    out, err = capsys.readouterr()
    assert "certify fetch reach: 10/10" in err
    data = json.loads((folder / "certificate.json").read_text())
    assert (data["robot"], data["task"]) == ("fetch", "reach")
    assert data["fingerprint"] == env_fingerprint(ENV)
    assert data["settings"]["cases"] == 2
    assert [case[0] for case in data["rows"][0]["cases"]] == [5_000_000, 5_000_001]
    lines = out.splitlines()
    for row in data["rows"]:
        line = next(line for line in lines if line.startswith(f"|{row['words']}"))
        assert "100.0 % [" in line
    assert f"at least {data['mu']} steps" in out
    assert (folder / "config.yaml").is_file()
