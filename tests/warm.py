"""Commands in forks of a process that has imported LeRobot, so that not every one of them takes
seconds to start.
"""

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


class Warm(AbstractContextManager["Warm"]):
    """The process starts when it is first needed. home: its own. imported: modules of ours that
    it has imported too.
    """

    def __init__(
        self, environment: Mapping[str, str], home: Path, imported: Sequence[str] = ()
    ) -> None:
        self._environment, self._home, self._imported = environment, home, imported
        self._process: subprocess.Popen[str] | None = None

    def run(self, *words: object, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
        """A command as in a shell. `python` runs a file, or code behind `-c`."""
        if self._process is None:
            child = [
                sys.executable,
                str(Path(__file__).with_name("warm_child.py")),
                *self._imported,
            ]
            folders = {"HOME": "", "HF_HOME": "hf", "HF_LEROBOT_HOME": "hf/lerobot"}
            environment = {
                **self._environment,
                **{name: str(self._home / path) for name, path in folders.items()},
            }
            pipe = subprocess.PIPE
            self._process = subprocess.Popen(
                child, env=environment, stdin=pipe, stdout=pipe, text=True, cwd=ROOT
            )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        line, out, err = [str(word) for word in words], self._home / "out", self._home / "err"
        job = {"words": line, "folder": str(folder or self._home), "out": str(out), "err": str(err)}
        print(json.dumps(job), file=self._process.stdin, flush=True)
        code = self._process.stdout.readline()
        said = [path.read_text(encoding="utf-8", errors="replace") for path in (out, err)]
        return subprocess.CompletedProcess(line, int(code), *said)

    def __exit__(self, *error: object) -> None:
        if self._process is not None:
            assert self._process.stdin is not None
            self._process.stdin.close()
            self._process.wait(60)
