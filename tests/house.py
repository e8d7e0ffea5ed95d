"""Check what linters do not: docstrings that begin with a verb, shapes and units of arrays, circles of imports.

python -m tests.house [--counts]

A public function's docstring begins with a verb; a property's or class's with a noun or a verb, and a noun of a value
with its unit. A function that takes or gives arrays says a shape, `(B, n)`, or a unit, `[m]`. Modules import each other
in no circle, imports for type checkers included. Exits with 1 where something is found.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "manip_il"
MOST_LINES, MOST_FUNCTION_LINES = 300, 50
_VERBS = """
    accept add advance align allow answer append apply approach arrange ask assign attach average begin bind blend block
    blur bring build call cancel carry check choose clean clear clip clone close collect combine command compare compile
    compute copy count create crop cut decide decode define delete describe disable divide draw drive drop dump enable
    encode end enter estimate evaluate examine execute exit expand explain export extend feed fetch fill find finish fit
    flip follow forget format free freeze gather generate get give go grasp group guard handle have hide hold ignore
    import interpolate invoke join keep kill know label lay leave let lift limit list listen load lock log look lower
    make map mark match measure merge move multiply name normalise normalize note observe open order pad paint parse
    pause pick place plan plot point predict prepare press print push put query raise rank read rebuild receive record
    recover refuse register reject release remember remove rename render repair repeat replace report request reset
    resolve restore resume return reverse rewrite roll rotate round run sample save say scale scan score search see seed
    select send serve set settle shift show shuffle shut simulate skip solve sort split standardise start state step
    stop store stream strip summarise sum switch take tell test throw time train transform translate trim try turn
    undo unpack update upload use validate verify wait walk warn watch weigh wipe wrap write yield
"""
_NO_NOUN = """
    and as at between by for from further how in it its nobody of on once or somebody something than that those to under
    until what when where which while who whose with within without
"""
VERBS, NO_NOUN = frozenset(_VERBS.split()), frozenset(_NO_NOUN.split())
ARRAY = re.compile(r"\b(NDArray|ndarray|Tensor|F32|F64|I64|U8|Array)\b")
SHAPE = re.compile(r"\([\w.* +-]*,[\w.,* +-]*\)|\[[^\]]+\]")


def main(words: list[str]) -> int:
    """Print what is found; the counts too with `--counts`."""
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(PACKAGE.rglob("*.py"))}
    found = [*docstrings(trees), *arrays(trees), *circles(trees)]
    print("\n".join(found), end="\n" if found else "")
    if "--counts" in words:
        lines = sum(len(path.read_text(encoding="utf-8").splitlines()) for path in trees)
        print(f"{len(trees)} files, {lines:,} lines")
        print("\n".join(long(trees)))
    return 1 if found else 0


def docstrings(trees: Mapping[Path, ast.Module]) -> Iterator[str]:
    """Yield a line for every public docstring that begins with the wrong kind of word."""
    for path, node, name in public(trees):
        words = (ast.get_docstring(node) or "").split()
        if not words:
            continue
        first = words[0].strip(".,:;").lower()
        if isinstance(node, ast.ClassDef) or is_property(node):
            if first in NO_NOUN:
                yield f"{where(path, node)}: {name}: {words[0]!r} begins its docstring; expected a noun or a verb"
        elif not VERBS & {first, first.removesuffix("s"), first.removesuffix("es"), re.sub("ies$", "y", first)}:
            yield f"{where(path, node)}: {name}: {words[0]!r} begins its docstring; expected a verb"


def arrays(trees: Mapping[Path, ast.Module]) -> Iterator[str]:
    """Yield a line for every public function of arrays whose docstring has neither shape nor unit."""
    for path, node, name in public(trees):
        if isinstance(node, ast.ClassDef) or not (doc := ast.get_docstring(node)):
            continue
        given = [node.returns, *(one.annotation for one in [*node.args.args, *node.args.kwonlyargs])]
        if any(ARRAY.search(ast.unparse(one)) for one in given if one) and not SHAPE.search(doc):
            yield f"{where(path, node)}: {name}: arrays without a shape, (B, n), or a unit, [m], in the docstring"


def circles(trees: Mapping[Path, ast.Module]) -> Iterator[str]:
    """Yield a line for a circle of modules that import each other."""
    names = {module(path): path for path in trees}
    try:
        TopologicalSorter({name: {*imported(trees[path], names)} - {name} for name, path in names.items()}).prepare()
    except CycleError as error:
        yield f"circle of imports: {' <- '.join(error.args[1])}"


def imported(tree: ast.Module, known: Iterable[str]) -> Iterator[str]:
    """Yield the package's own modules that a module imports when it is loaded, for type checkers included."""
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


def long(trees: Mapping[Path, ast.Module]) -> Iterator[str]:
    """Yield a line for every file and function that is longer than agreed."""
    for path, tree in trees.items():
        if (lines := len(path.read_text(encoding="utf-8").splitlines())) > MOST_LINES:
            yield f"{path.relative_to(PACKAGE.parent)}: {lines} lines; expected at most {MOST_LINES}"
        for node in (one for one in ast.walk(tree) if isinstance(one, ast.FunctionDef)):
            if (lines := (node.end_lineno or 0) - node.lineno + 1) > MOST_FUNCTION_LINES:
                yield f"{where(path, node)}: {node.name}: {lines} lines; expected at most {MOST_FUNCTION_LINES}"


def public(trees: Mapping[Path, ast.Module]) -> Iterator[tuple[Path, ast.FunctionDef | ast.ClassDef, str]]:
    """Yield every public function, class and method with its name."""
    for path, tree in trees.items():
        yield from ((path, node, name) for node, name in _public(tree, ""))


def _public(scope: ast.Module | ast.ClassDef, prefix: str) -> Iterator[tuple[ast.FunctionDef | ast.ClassDef, str]]:
    for node in scope.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            yield node, prefix + node.name
            if isinstance(node, ast.ClassDef):
                yield from _public(node, f"{node.name}.")


def is_property(node: ast.FunctionDef) -> bool:
    """Return whether a method is read as a value."""
    return any(isinstance(one, ast.Name) and one.id in ("property", "cached_property") for one in node.decorator_list)


def module(path: Path) -> str:
    """Return the dotted name of a file."""
    return ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")


def where(path: Path, node: ast.FunctionDef | ast.ClassDef) -> str:
    """Return `file:line`."""
    return f"{path.relative_to(PACKAGE.parent)}:{node.lineno}"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
