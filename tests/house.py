"""Check what linters do not: shapes and units of arrays, and circles of imports.

python -m tests.house

The docstring of a public function that takes or gives arrays says a shape, `(B, n)`, or a unit,
`[m]`. Modules import each other in no circle, imports for type checkers included. Exits with 1 if
something is found.
"""

import ast
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "manip_il"
ARRAY = re.compile(r"\b(NDArray|ndarray|Tensor|F32|F64|I64|U8|Array)\b")
SHAPE = re.compile(r"\([\w.* +-]*,[\w.,* +-]*\)|\[[^\]]+\]")


def main() -> int:
    """Print what is found."""
    trees = {
        path: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(PACKAGE.rglob("*.py"))
    }
    found = [*arrays(trees), *circles(trees)]
    print("\n".join(found), end="\n" if found else "")
    return 1 if found else 0


def arrays(trees: Mapping[Path, ast.Module]) -> Iterator[str]:
    """Yield a line for every public function of arrays whose docstring has neither shape nor
    unit.
    """
    for path, node, name in public(trees):
        if isinstance(node, ast.ClassDef) or not (doc := ast.get_docstring(node)):
            continue
        given = [
            node.returns,
            *(one.annotation for one in [*node.args.args, *node.args.kwonlyargs]),
        ]
        if any(ARRAY.search(ast.unparse(one)) for one in given if one) and not SHAPE.search(doc):
            yield (
                f"{where(path, node)}: {name}: arrays without a shape, (B, n), or a unit, [m], in"
                " the docstring"
            )


def circles(trees: Mapping[Path, ast.Module]) -> Iterator[str]:
    """Yield a line for a circle of modules that import each other."""
    names = {module(path): path for path in trees}
    try:
        TopologicalSorter(
            {name: {*imported(trees[path], names)} - {name} for name, path in names.items()}
        ).prepare()
    except CycleError as error:
        yield f"circle of imports: {' <- '.join(error.args[1])}"


def imported(tree: ast.Module, known: Iterable[str]) -> Iterator[str]:
    """Yield the package's own modules that a module imports when it is loaded, for type checkers
    included.
    """
    known = set(known)
    for node in _loaded(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in known)
        elif isinstance(node, ast.ImportFrom) and node.module in known:
            inner = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from (one if one in known else node.module for one in inner if node.module)


def _loaded(node: ast.AST) -> Iterator[ast.AST]:
    for child in ast.iter_child_nodes(node):
        yield child
        if not isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            yield from _loaded(child)


def public(
    trees: Mapping[Path, ast.Module],
) -> Iterator[tuple[Path, ast.FunctionDef | ast.ClassDef, str]]:
    """Yield every public function, class and method with its name."""
    for path, tree in trees.items():
        yield from ((path, node, name) for node, name in _public(tree, ""))


def _public(
    scope: ast.Module | ast.ClassDef, prefix: str
) -> Iterator[tuple[ast.FunctionDef | ast.ClassDef, str]]:
    for node in scope.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            yield node, prefix + node.name
            if isinstance(node, ast.ClassDef):
                yield from _public(node, f"{node.name}.")


def module(path: Path) -> str:
    """Return the dotted name of a file."""
    return ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(
        ".__init__"
    )


def where(path: Path, node: ast.FunctionDef | ast.ClassDef) -> str:
    """Return `file:line`."""
    return f"{path.relative_to(PACKAGE.parent)}:{node.lineno}"


if __name__ == "__main__":
    sys.exit(main())
