"""`manip-il export`: a policy in one file that runs without this package."""

from __future__ import annotations

from dataclasses import MISSING, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import ClassVar, Literal

from manip_il.cli.outputs import check_new_file
from manip_il.cli.progress import say, warn
from manip_il.data.atomic import write_file
from manip_il.errors import ManipError
from manip_il.evaluation.policy_folder import find_policy
from manip_il.option import option

EXPORTABLE = ("mlp", "cnn")
ONNX_PACKAGES = ("onnx", "onnxruntime")


@dataclass
class ExportOptions:
    """Write an mlp or cnn policy as one file that runs without this package.

    Observations go in raw, by LeRobot's names; joint targets [rad] and the gripper command [m] come out. The file is
    run and compared with the checkpoint before it is written. docs/export.md shows how to run it.
    """

    example: ClassVar[str] = "manip-il export runs/dagger --output=policy.onnx"
    policy: Path = option(MISSING, "a run, a checkpoint or its pretrained_model", positional=True, check=find_policy)
    format: Literal["onnx"] = option("onnx", "for onnxruntime and others")
    output: Path = option(Path("policy.onnx"), "the file")
    overwrite: bool = option(False, "replace an existing file")

    def run(self) -> None:
        """Export, compare, write."""
        check_new_file(self.output, self.overwrite)
        path = find_policy(self.policy)
        from manip_il.learn.checkpoint import read_config

        kind = read_config(path)["type"]
        if kind not in EXPORTABLE:
            raise ManipError(f"{path} is a policy of type {kind!r}; only {' and '.join(EXPORTABLE)} can be exported")
        if missing := [name for name in ONNX_PACKAGES if find_spec(name) is None]:
            raise ManipError(f"an ONNX file needs {' and '.join(missing)}: pip install 'manip_il[export]'")
        from manip_il.learn.checkpoint import policy_sha256
        from manip_il.learn.export import export_onnx

        exported = export_onnx(path, policy_sha256(path))
        write_file(self.output, exported.data)
        if "robot" not in exported.metadata:
            warn(f"{path} was written by another tool: the file does not say robot, task, control rate and names")
        say(f"largest difference from {path} over random observations: {exported.difference:.1e}")
        for direction, tensors in (("in", exported.metadata["inputs"]), ("out", exported.metadata["outputs"])):
            for one in tensors:
                say(f"{direction:>3}: {one['name']} {one['dtype']} ({', '.join(map(str, one['shape']))})")
        say(f"exported: {self.output} ({len(exported.data):,} bytes)")
