"""The rules of structure: each fails on a violation, and none on what keeps it."""

from __future__ import annotations

import pytest

from tests.scripts import REPOSITORY, script

structure = script(".ci/structure.py")


def findings(rule: str, **texts: str) -> list[str]:
    """What a rule finds in modules of a package `p`; `__` in a name stands for the dot of a sub-package."""
    modules = [structure.module("p", ""), *(structure.module(f"p.{n.replace('__', '.')}", t) for n, t in texts.items())]
    return list(getattr(structure, rule)(modules))


def test_a_module_of_401_lines_is_found_and_one_of_400_is_not() -> None:
    assert findings("long_modules", a="\n" * 400, b="") == []
    assert findings("long_modules", a="\n" * 401, b="") == ["p.a: expected at most 400 lines, got 401"]


def test_a_module_of_commands_has_a_lower_bound() -> None:
    assert findings("long_modules", cli__a="\n" * 251, b="") == ["p.cli.a: expected at most 250 lines, got 251"]


def test_a_median_above_120_lines_is_found() -> None:
    texts = dict.fromkeys("abc", "\n" * 121)
    assert findings("long_modules", **texts) == ["all modules: expected a median of at most 120 lines, got 121"]


def test_a_circle_of_imports_is_found_even_inside_functions() -> None:
    circle = findings("import_circles", a="from p import b", b="def f():\n    from p.a import x")
    assert len(circle) == 1 and "p.a" in circle[0] and "p.b" in circle[0]
    assert findings("import_circles", a="from p import b", b="") == []


def test_a_package_that_its_own_modules_import_from_is_a_circle() -> None:
    found = findings("import_circles", s="from p.s.a import x", s__a="from p.s import y")
    assert found == ["import circle: p.s -> p.s.a -> p.s"] or found == ["import circle: p.s.a -> p.s -> p.s.a"]


def test_the_package_itself_may_open_lazily_what_imports_it() -> None:
    modules = [
        structure.module("p", "def __getattr__(name):\n    from p.a import x"),
        structure.module("p.a", "import p"),
    ]
    assert list(structure.import_circles(modules)) == []


def test_a_function_of_61_lines_is_found_but_its_docstring_does_not_count() -> None:
    body = "    x = 1\n" * 59
    assert findings("large_functions", a="def f():\n" + body) == []
    assert findings("large_functions", a='def f():\n    """One.\n\n    Two.\n    """\n' + body) == []
    assert findings("large_functions", a="def f():\n    x = 2\n" + body) == [
        "p.a.f (line 1): expected at most 60 lines, got 61"
    ]


@pytest.mark.parametrize("kinds", ["a, b, c, d, e, f, g, h, i", "a, b, c, /, d, e, f, *, g, h, i"])
def test_a_function_of_nine_parameters_is_found(kinds: str) -> None:
    assert findings("large_functions", a=f"def f({kinds}): ...") == [
        "p.a.f (line 1): expected at most 8 parameters or a settings object, got 9"
    ]
    assert findings("large_functions", a=f"class A:\n    def f(self, {kinds[3:]}): ...") == []


@pytest.mark.parametrize("decorator", ["compiled", "compiled(parallel=True)", "numba.njit", "app.command('x')"])
def test_compiled_functions_and_commands_may_have_more_parameters(decorator: str) -> None:
    assert findings("large_functions", a=f"@{decorator}\ndef f(a, b, c, d, e, f, g, h, i): ...") == []


def test_a_class_name_with_two_meanings_is_found_and_a_private_one_is_not() -> None:
    assert findings("shared_names", a="class View: ...", b="class View: ...") == [
        "class View: expected one meaning, got p.a, p.b"
    ]
    assert findings("shared_names", a="class _View: ...", b="class _View: ...") == []


def test_a_number_with_two_values_is_found_and_one_with_a_single_value_is_not() -> None:
    assert findings("shared_names", a="NEAR = 0.05", b="NEAR: float = 0.02") == [
        "constant NEAR: expected one value, got 0.05 p.a, 0.02 p.b"
    ]
    assert findings("shared_names", a="NEAR = 0.05", b="NEAR = 0.05\nFILE = 'x'", c="FILE = 'y'") == []


@pytest.mark.parametrize("number", ["3", "-1.5", "512 * 2**20", "(0.1, 0.2)"])
def test_a_number_without_a_word_is_found(number: str) -> None:
    assert findings("silent_numbers", a=f"import os\n\nNEAR = {number}\n") == [
        "p.a.NEAR (line 3): expected a comment or docstring with unit and origin"
    ]


@pytest.mark.parametrize(
    "text",
    [
        'NEAR = 3\n"""Metres; measured."""\n',
        "# Metres; measured.\nNEAR = 3\n",
        "NEAR = 3  # metres; measured\n",
        "NAME = 'x'\n",
        "near = 3\n",
    ],
)
def test_a_number_with_a_word_and_what_is_no_number_are_not_found(text: str) -> None:
    assert findings("silent_numbers", a=text) == []


def test_the_package_keeps_the_rules() -> None:
    modules = structure.read(REPOSITORY / "bask_data")
    assert [finding for rule in structure.RULES for finding in rule(modules)] == []
