"""The form in which source is hashed: what counts, what does not, and that all Pythons agree."""

import functools
import hashlib
import os
import re
import subprocess
import sys
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from offboard.common.source import normal_form as module
from offboard.common.source.normal_form import normal_form

OLDEST = (3, 10)
DIGEST = "53b1d1b3dc96a2a62930f77780dbae7e64fee11a7580e9daa65fd96fa5fb6359"  # of SAMPLE on every Python

# Whatever the syntax tree of one version of Python shows in another way than that of the next one.
SAMPLE = r'''import functools
from dataclasses import dataclass

WIDTH = 3


def texts(x, width=WIDTH, *rest, y: "int | None" = None, **more):
    """Docstring: {x}."""
    a = f"{x}" f"b{{c}}" "d" rf"\d{x!r:>{width}}" 'e'
    b = f"{x=}{x = !s:^{width}.{width}}{x:%H:%M}{x:}{'n' 'm'}\N{BULLET}"
    c = f"""{
        x
    } and
    {a}""" + f'{x:{"a"}}' + f"{{}}" + f"" + "é\u0378\U0001F600\ud800" + f"{x:{{}}}" if 0 else ""
    d = f"{f'{x}'}" + f"{x,}" + f"{(lambda: 1)()}" + f"{x:a{width}b{y}c}" + u"u"
    e = f"{x!a}" f'{y}' + f"\x41{x}\t" + rb"\d".hex() + f"{x}}}{y}{{"
    return a, b, c, d, e


@functools.lru_cache(maxsize=0x10)
@functools.wraps(texts)
def numbers(a, /, b=1_000, *, c=1e3, d=-0.0):
    return a + 1j * 0xFFFFFFFFFFFFFFFFFFFFFFFF + 1e400 - 5e-324 + ..., True, None, b"\x00\xff", not a


class Outer:
    "Doc."

    x: int = 3
    "attribute doc"

    @property
    def value(self):
        return self.x

    @value.setter
    def value(self, new):
        self.x = new

    class Inner(dict, metaclass=type):
        async def go(self, *args):
            async with self as (a, b), self:
                async for x in a:
                    yield [await y async for y in b if y if x]
            try:
                del a[1:2, ::3], b.c
            except (ValueError, OSError) as error:
                raise error from None
            else:
                ...
            finally:
                nonlocal_ = {**a, 1: 2, **b}

    def match(self, thing):
        match thing:
            case {"a": 1 | None, **rest}:
                return rest
            case [1, *_, Outer(x=3, y=-1.5)] if thing:
                return lambda z, *w: z[(w, *w)]
            case _:
                while (n := thing) and n != 3 or not n is None:
                    global WIDTH
                    WIDTH @= n // 2 ** -n
                else:
                    assert n, "x"


to_half = lambda points: points + 1  # comment
pair = (lambda a: a, lambda b: b)


@dataclass
class Pose:
    x: float = 0.0
'''
NAMES = ("texts", "numbers", "Outer", "Outer.Inner", "to_half", "pair", "Pose")

SCRIPT = """
import functools, hashlib, sys, warnings
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
warnings.simplefilter("ignore")
sys.dont_write_bytecode = True
def load(name, path):
    loader = SourceFileLoader(name, path)
    made = sys.modules[name] = module_from_spec(spec_from_loader(name, loader))
    loader.exec_module(made)
    return made
form, sample = load("normal_form", sys.argv[1]), load("sample", sys.argv[2])
found = [functools.reduce(getattr, name.split("."), sample) for name in sys.argv[3:]]
found = [one[0] if isinstance(one, tuple) else one for one in found]
texts = [form.normal_form(one) for one in found]
assert all(texts), texts
print(hashlib.sha256("\\0".join(texts).encode()).hexdigest())
"""


def loaded(path: Path, text: str) -> ModuleType:
    path.write_text(text)
    loader = SourceFileLoader(path.stem, str(path))
    spec = spec_from_loader(path.stem, loader)
    assert spec is not None
    made = sys.modules[path.stem] = module_from_spec(spec)
    loader.exec_module(made)
    return made


def form_of(folder: Path, text: str, name: str = "f") -> str:
    """The normal form of one name in a new module with this text."""
    path = folder / f"made_{hashlib.sha256(text.encode()).hexdigest()[:16]}.py"
    form = normal_form(functools.reduce(getattr, name.split("."), loaded(path, text)))
    assert form
    return form


def pythons() -> list[str]:
    """Each Python from 3.10 on that is installed here: on PATH, or next to others of the same user."""
    folders = [Path(one) for one in os.get_exec_path()]
    root = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    folders += [one / "bin" for one in root.glob("versions/*")]
    found = {}
    for folder in folders:
        for path in folder.glob("python3.*"):
            if not re.fullmatch(r"python3\.\d+", path.name):
                continue
            version = tuple(map(int, path.name.removeprefix("python").split(".")))
            asked = subprocess.run([path, "-c", "print('runs')"], capture_output=True, text=True, check=False)
            if (
                version >= OLDEST and asked.stdout == "runs\n"
            ):  # a shim of a version that is switched off fails
                found.setdefault(path.resolve(), str(path))
    return [sys.executable, *found.values()]


PYTHONS = pythons()


@pytest.mark.parametrize("python", PYTHONS, ids=lambda path: Path(path).name)
def test_the_hash_is_the_same_on_every_python(python: str, tmp_path: Path) -> None:
    """Each Python that is installed here finds the hash that was written down for this sample."""
    path = tmp_path / "sample.py"
    path.write_text(SAMPLE)
    done = subprocess.run(
        [python, "-I", "-c", SCRIPT, str(module.__file__), str(path), *NAMES],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.stderr, done.stdout.strip()) == ("", DIGEST)


PLAIN = """
def f(x, y=1):
    a = {"k": x, 'l': f"{x!r:>{y}}"}
    return g(a, x + y)
"""


SAME = {
    "comment and docstring": """# first
def f(x, y=1):  # more
    'Doc.'
    a = {"k": x, "l": f"{x!r:>{y}}"}
    return g(a, x + y)
""",
    "line breaks and quotes": """def f(
    x,
    y = 0x1,
):
    a = {
        'k': x,
        'l': f'{x!r:>{y}}',
    }

    return (g(a, (x + y)))
""",
    "indentation": """if True:

  def f(x, y=1):
    a = {'k': x, 'l': f'{x!r:>{y}}'}; return g(a,
  x+y)
""",
    "text": """def f(x, y=1):
    a = {'k': x, 'l': f"{x!r:>{y}}"}
    'A text as a comment.'
    return g(a, x + y)
""",
}


@pytest.mark.parametrize("other", SAME.values(), ids=SAME)
def test_comments_docstrings_and_formatting_do_not_count(other: str, tmp_path: Path) -> None:
    """Whatever a formatter or a writer of comments changes leaves the form as it is."""
    assert form_of(tmp_path, other) == form_of(tmp_path, PLAIN)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("x + y", "x - y"),
        ("x + y", "y + x"),
        ("y=1", "y=1.0"),
        ("y=1", "y=True"),
        ("'l'", "b'l'"),
        ("'l'", "'L'"),
        ("!r", "!s"),
        ("!r", ""),
        (">{y}", ""),
        (">{y}", "<{y}"),
        ("(x, y=1)", "(x, *, y=1)"),
        ("(x, y=1)", "(x, /, y=1)"),
        ("return g", "g"),
        ("return g(a, x + y)", "return"),
        ("return g(a, x + y)", "return f''"),
        ("return g(a, x + y)", "return None"),
        ("def f", "@staticmethod\ndef f"),
    ],
)
def test_code_counts(old: str, new: str, tmp_path: Path) -> None:
    """Each of these changes is another form."""
    changed = PLAIN.replace(old, new)
    assert changed != PLAIN
    assert form_of(tmp_path, changed) != form_of(tmp_path, PLAIN)


def test_what_a_text_says_counts_however_far_the_code_is_indented(tmp_path: Path) -> None:
    """The lines of a text within a function keep their spaces."""
    texts = [f'def f():\n    return """\n{" " * spaces}x"""\n' for spaces in (0, 4)]
    assert form_of(tmp_path, texts[0]) != form_of(tmp_path, texts[1])


def test_a_lambda_counts_with_its_statement(tmp_path: Path) -> None:
    """Only the statement that holds it, and not its line breaks."""
    one = form_of(tmp_path, "f = lambda x: x + 1\ng = lambda x: x\n")
    assert one == form_of(tmp_path, "f = (\n    lambda x: x\n    + 1  # more\n)\ng = lambda x: 2\n")
    assert one != form_of(tmp_path, "f = lambda x: x + 2\ng = lambda x: x\n")


def test_a_partial_and_a_decorated_function_count_as_the_function(tmp_path: Path) -> None:
    """What is wrapped is found, if the wrapper says what it wraps."""
    text = PLAIN + "import functools\np = functools.partial(f, 3)\nc = functools.lru_cache(f)\n"
    assert form_of(tmp_path, text, "p") == form_of(tmp_path, text, "c") == form_of(tmp_path, PLAIN)


def test_of_two_definitions_with_one_name_both_count(tmp_path: Path) -> None:
    """Which of them runs may depend on the computer."""
    text = "if {}:\n    def f(): return 1\nelse:\n    def f(): return {}\n"
    forms = [form_of(tmp_path, text.format(*one)) for one in ((True, 2), (False, 2), (True, 3))]
    assert forms[0] == forms[1] != forms[2]


def test_a_class_counts_with_its_methods(tmp_path: Path) -> None:
    """A method, a base and a field count; a docstring of a field does not."""
    text = "class f(dict):\n    x: int = 1\n    def go(self): return {}\n"
    one = form_of(tmp_path, text.format(1))
    assert one == form_of(tmp_path, text.format(1).replace("= 1\n", "= 1\n    'The x.'\n"))
    assert one != form_of(tmp_path, text.format(2))
    assert one != form_of(tmp_path, text.format(1).replace("dict", "list"))


@pytest.mark.parametrize("of", [len, int, 3, None, type("Made", (), {}), functools.partial(len)], ids=repr)
def test_what_has_no_source_has_no_form(of: Any) -> None:
    """Its form is empty, and nothing is raised."""
    assert normal_form(of) == ""


def test_a_file_that_warns_is_read_without_a_warning(tmp_path: Path) -> None:
    """Its import has warned already, and tests turn warnings into errors."""
    text = 'def f():\n    return "\\d"\n'
    with pytest.warns((DeprecationWarning, SyntaxWarning)):
        made = loaded(tmp_path / "warns.py", text)
    assert "\\\\d" in normal_form(made.f)


def test_a_deep_tree_is_no_recursion(tmp_path: Path) -> None:
    """A sum of a thousand terms has a form."""
    assert form_of(tmp_path, f"def f(x):\n    return {' + '.join(['x'] * 1000)}\n").count("BinOp") == 999
