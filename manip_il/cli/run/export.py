"""Run `manip-il export`: a policy as one ONNX file."""

from manip_il.cli.progress import say
from manip_il.cli.transfer import ExportOptions
from manip_il.data.atomic import write_file
from manip_il.errors import ManipError
from manip_il.learn.checkpoint import find_policy, read_config
from manip_il.learn.export import export_onnx

EXPORTABLE = ("mlp", "cnn")


def run_export(options: ExportOptions) -> None:
    """Export, compare, write."""
    options.check()
    path = find_policy(options.policy)
    if (kind := read_config(path)["type"]) not in EXPORTABLE:
        raise ManipError(
            f"{path} is a policy of type {kind!r}; only {' and '.join(EXPORTABLE)} can be exported"
        )
    try:
        content, difference = export_onnx(path)
    except ImportError as error:
        raise ManipError(
            f"an ONNX file needs {error.name}: pip install 'manip_il[export]'"
        ) from error
    write_file(options.output, content)
    say(f"largest difference from {path} over random observations: {difference:.1e}")
    say(f"exported: {options.output} ({len(content):,} bytes)")
