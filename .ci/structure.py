"""Check the rules of structure that no linter knows; `make check` runs this, docs/decisions/0011 says why.

Every rule is a function from parsed modules to findings, so that a test can hand it a violation.
"""

from __future__ import annotations

import ast
import io
import statistics
import sys
import tokenize
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

MOST_LINES = 400
"""Of a module: what a reader can still take in as one text."""
MOST_MEDIAN_LINES = 120
"""Of all modules: keeps the large ones the exception."""
MOST_COMMAND_LINES = 250
"""Of a module in `cli/`, whose commands parse, call and print, and decide nothing."""
MOST_FUNCTION_LINES = 60
"""Of a function without its docstring."""
MOST_PARAMETERS = 8
"""Of a function; more belong into a settings object."""

COMPILED = {"compiled", "njit", "jit", "vectorize", "guvectorize"}


@dataclass(frozen=True)
class Module:
    """One module of the package: its dotted name, its text and its syntax tree."""

    name: str
    text: str
    tree: ast.Module

    @property
    def n_lines(self) -> int:
        return len(self.text.splitlines())


def module(name: str, text: str) -> Module:
    """A module from its text."""
    return Module(name, text, ast.parse(text))


def read(package: Path) -> list[Module]:
    """All modules of a package, by name."""
    found = []
    for file in sorted(package.rglob("*.py")):
        parts = file.relative_to(package.parent).with_suffix("").parts
        found.append(module(".".join(parts[:-1] if parts[-1] == "__init__" else parts), file.read_text()))
    return found


# Rules ----------------------------------------------------------------------------------------------------------------


def long_modules(modules: list[Module]) -> Iterator[str]:
    """Modules above the bound, and a median above its own."""
    for each in modules:
        most = MOST_COMMAND_LINES if each.name.split(".")[1:2] == ["cli"] else MOST_LINES
        if each.n_lines > most:
            yield f"{each.name}: expected at most {most} lines, got {each.n_lines}"
    median = statistics.median(each.n_lines for each in modules)
    if median > MOST_MEDIAN_LINES:
        yield f"all modules: expected a median of at most {MOST_MEDIAN_LINES} lines, got {median:g}"


def import_circles(modules: list[Module]) -> Iterator[str]:
    """One circle of imports, if there is any; an import inside a function counts, one for type checkers does, too."""
    names = {each.name for each in modules}
    graph = {each.name: _imported(each, names) for each in modules}
    root = modules[0].name.split(".")[0]
    graph[root] = set()  # The package's own module opens lazily what users ask it for, and everything imports it.
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        yield "import circle: " + " -> ".join(reversed(error.args[1]))


def large_functions(modules: list[Module]) -> Iterator[str]:
    """Functions with too many lines or parameters.

    What numba compiles may have more parameters: it takes arrays and numbers, no settings object. So may commands,
    whose parameters are the options a person types.
    """
    for each in modules:
        for node in ast.walk(each.tree):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            place = f"{each.name}.{node.name} (line {node.lineno})"
            if (n_lines := _lines_without_docstring(node)) > MOST_FUNCTION_LINES:
                yield f"{place}: expected at most {MOST_FUNCTION_LINES} lines, got {n_lines}"
            if _decorators(node) & (COMPILED | {"command", "callback"}):
                continue
            if (n_parameters := _n_parameters(node)) > MOST_PARAMETERS:
                yield f"{place}: expected at most {MOST_PARAMETERS} parameters or a settings object, got {n_parameters}"


def shared_names(modules: list[Module]) -> Iterator[str]:
    """Public classes that bear one name in several modules, and numbers that bear one name with several values."""
    classes, constants = defaultdict(list), defaultdict(dict)
    for each in modules:
        for node in each.tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                classes[node.name].append(each.name)
        for name, value, _ in _constants(each):
            if _is_number(value):
                constants[name][each.name] = ast.unparse(value)
    for name, places in sorted(classes.items()):
        if len(places) > 1:
            yield f"class {name}: expected one meaning, got {', '.join(places)}"
    for name, values in sorted(constants.items()):
        if len(set(values.values())) > 1:
            yield f"constant {name}: expected one value, got " + ", ".join(f"{of} {at}" for at, of in values.items())


def silent_numbers(modules: list[Module]) -> Iterator[str]:
    """Named numbers without a word on unit and origin: a docstring below, or a comment above or beside."""
    for each in modules:
        spoken = _documented_lines(each)
        for name, value, line in _constants(each):
            if _is_number(value) and line not in spoken:
                yield f"{each.name}.{name} (line {line}): expected a comment or docstring with unit and origin"


RULES = (long_modules, import_circles, large_functions, shared_names, silent_numbers)


# What the rules read --------------------------------------------------------------------------------------------------


def _imported(each: Module, names: set[str]) -> set[str]:
    found = set()
    for node in ast.walk(each.tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {
                inner if (inner := f"{node.module}.{alias.name}") in names else node.module for alias in node.names
            }
    return (found & names) - {each.name}


def _lines_without_docstring(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    lines = (node.end_lineno or node.lineno) - node.lineno + 1
    if ast.get_docstring(node) is not None:
        first = node.body[0]
        lines -= (first.end_lineno or first.lineno) - first.lineno + 1
    return lines


def _decorators(node: ast.FunctionDef | ast.AsyncFunctionDef) -> set[str]:
    found = set()
    for decorator in node.decorator_list:
        name = decorator.func if isinstance(decorator, ast.Call) else decorator
        found.add(name.attr if isinstance(name, ast.Attribute) else getattr(name, "id", ""))
    return found


def _n_parameters(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    given = node.args
    names = [argument.arg for argument in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
    return len([name for name in names if name not in ("self", "cls")])


def _constants(each: Module) -> Iterator[tuple[str, ast.expr, int]]:
    """Name, value and line of each constant of a module."""
    for node in each.tree.body:
        if isinstance(node, ast.Assign) and len(node.targets) == 1:
            target, value = node.targets[0], node.value
        elif isinstance(node, ast.AnnAssign) and node.value is not None:
            target, value = node.target, node.value
        else:
            continue
        if isinstance(target, ast.Name) and target.id.isupper():
            yield target.id, value, node.lineno


def _is_number(value: ast.expr) -> bool:
    """Whether an expression is made of numbers alone."""
    allowed = (ast.Constant, ast.BinOp, ast.UnaryOp, ast.operator, ast.unaryop, ast.Tuple, ast.Load)
    nodes = list(ast.walk(value))
    numbers = [type(node.value) in (int, float) for node in nodes if isinstance(node, ast.Constant)]
    return all(isinstance(node, allowed) for node in nodes) and bool(numbers) and all(numbers)


def _documented_lines(each: Module) -> set[int]:
    """Lines of assignments that a docstring follows, or that a comment stands above or beside."""
    found = set()
    for node, after in zip(each.tree.body, each.tree.body[1:], strict=False):
        if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) and isinstance(after.value.value, str):
            found.add(node.lineno)
    tokens: Mapping[int, int] = {
        token.start[0]: token.start[0]
        for token in tokenize.generate_tokens(io.StringIO(each.text).readline)
        if token.type == tokenize.COMMENT
    }
    for node in each.tree.body:
        lines = range(node.lineno - 1, (node.end_lineno or node.lineno) + 1)
        if any(line in tokens for line in lines):
            found.add(node.lineno)
    return found


def main() -> None:
    """Print every finding; exit code 1 if there is one."""
    modules = read(ROOT / "bask_data")
    findings = [finding for rule in RULES for finding in rule(modules)]
    print("\n".join(findings) or f"structure: {len(modules)} modules, nothing found")
    sys.exit(1 if findings else 0)


if __name__ == "__main__":
    main()
