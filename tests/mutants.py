"""Find small faults that the quick tests miss: `python tests/mutants.py [MODULE ...] [--sample N] [--seed N]`.

A mutant is a module with one operator, constant, condition or order of arguments changed, or one statement removed. For
each, a new process runs the quick tests that call the changed function, from the module's test file and those in
`ALSO`. The mutants in `tests/equivalent_mutants.txt` are equivalent to the original and left out.
"""

import argparse
import ast
import copy
import json
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

import pytest

ROOT = Path(__file__).resolve().parents[1]
MODULES = (
    *("comparison.decision", "comparison.verdict", "learning.objectives", "replay.memory", "runs.journal"),
    *("training.checkpoint", "training.trainer", "sessions.sweep"),
)
ALSO = {
    "training.trainer": ("training.checkpoint", "hostile_files"),
    "replay.memory": ("training.checkpoint",),
    "comparison.decision": ("comparison.verdict",),
}
LEAST = 0.9  # of a module's mutants
OPERATORS: dict[type[ast.AST], tuple[type[ast.AST], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
    ast.And: (ast.Or,),
    ast.Or: (ast.And,),
    ast.Add: (ast.Sub,),
    ast.Sub: (ast.Add,),
    ast.Mult: (ast.Div,),
    ast.Div: (ast.Mult,),
    ast.FloorDiv: (ast.Mult,),
    ast.Mod: (ast.Mult,),
    ast.Pow: (ast.Mult,),
    ast.BitAnd: (ast.BitOr,),
    ast.BitOr: (ast.BitAnd,),
}
REMOVED = (ast.AugAssign, ast.Break, ast.Continue, ast.Delete, ast.For, ast.If, ast.Raise, ast.While)
SYMMETRIC = ("array_equal", "max", "maximum", "min", "minimum", "swapaxes")
UNREAD = {"annotation", "returns", "decorator_list", "bases"}  # without behaviour, or run at import


@dataclass(frozen=True)
class Mutant:
    """A node of a module's tree and its replacement; `first` and `last` are the lines of its function."""

    place: tuple[ast.AST, str, int | None]
    node: ast.AST
    change: str
    line: int
    first: int
    last: int

    def apply(self) -> None:
        parent, field, index = self.place
        if index is None:
            setattr(parent, field, self.node)
        else:
            getattr(parent, field)[index] = self.node


def changed(node: ast.AST, in_function: bool) -> Iterator[ast.AST]:
    """Yield the replacements of a node."""
    if isinstance(node, ast.Constant) and isinstance(node.value, bool | int | float):
        yield ast.Constant(not node.value if isinstance(node.value, bool) else node.value + 1)
    if not in_function:
        return
    sides = (node.left, node.right) if isinstance(node, ast.BinOp) else ()
    if any(isinstance(each, ast.Constant) and isinstance(each.value, str) for each in sides):
        return  # a path or a text
    for field in ("op", "ops"):
        ops = getattr(node, field, None)
        for index, op in enumerate(ops if isinstance(ops, list) else [ops]):
            for other in OPERATORS.get(type(op), ()):
                new = copy.copy(node)
                setattr(new, field, [*ops[:index], other(), *ops[index + 1 :]] if isinstance(ops, list) else other())
                yield new
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub | ast.Invert):
        yield node.operand
    test = getattr(node, "test", None)
    if test and not isinstance(test, ast.Compare) and not (isinstance(test, ast.UnaryOp)):
        new = copy.copy(node)
        new.test = ast.UnaryOp(ast.Not(), test)  # type: ignore[attr-defined]
        yield new
    if isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] not in SYMMETRIC:
        texts = [ast.unparse(each) for each in node.args[:2] if not isinstance(each, ast.Starred)]
        if len(set(texts)) == 2:
            yield ast.Call(node.func, [*node.args[1::-1], *node.args[2:]], node.keywords)
    if isinstance(node, ast.Return) and not isinstance(node.value, ast.Constant | None):
        yield ast.Return(ast.Constant(None))
    stored = (each for target in getattr(node, "targets", ()) for each in ast.walk(target))
    is_call = isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
    if is_call or isinstance(node, REMOVED) or any(isinstance(each, ast.Attribute | ast.Subscript) for each in stored):
        yield ast.Pass()


def mutants_of(tree: ast.AST, function: ast.AST | None = None) -> Iterator[Mutant]:
    """Yield the mutants of a tree in the order of its lines."""
    for field, value in ast.iter_fields(tree):
        for index, node in enumerate(value) if isinstance(value, list) else [(None, value)]:
            if field in UNREAD or not isinstance(node, ast.AST):
                continue
            inside = function or (node if isinstance(node, ast.FunctionDef) else None)
            for new in changed(node, inside is not None) if isinstance(node, ast.stmt | ast.expr) else ():
                before, after = ast.unparse(node).split("\n"), ast.unparse(new).split("\n")
                change = f"{before[0]} -> {'' if isinstance(new, ast.Pass) else after[0]}".rstrip()
                lines = (0, 10**9)
                if isinstance(inside, ast.FunctionDef):
                    first = min([inside.lineno, *(each.lineno for each in inside.decorator_list)])
                    lines = first, inside.end_lineno or 0
                yield Mutant(
                    (tree, field, index), ast.copy_location(new, node), change, getattr(node, "lineno", 0), *lines
                )
            yield from mutants_of(node, inside)


class Watch:
    """Record each test's time and the functions of a file that it calls, by their first lines."""

    def __init__(self, file: Path) -> None:
        self.file = str(file)
        self.seconds: dict[str, float] = {}
        self.called: dict[str, list[int]] = {}

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        lines: set[int] = set()

        def trace(frame: FrameType, _event: str, _value: Any) -> None:
            if frame.f_code.co_filename == self.file:
                lines.add(frame.f_code.co_firstlineno)

        began = time.monotonic()
        threading.settrace(trace)
        sys.settrace(trace)
        yield
        sys.settrace(None)
        threading.settrace(None)
        self.seconds[item.nodeid], self.called[item.nodeid] = time.monotonic() - began, sorted(lines)


def ask(tests: Sequence[str], folder: Path, *options: str, plugin: object = None) -> int:
    """Run tests in this process, which must not have run any; return pytest's exit code."""
    from hypothesis import Phase, settings

    settings.register_profile("once", database=None, phases=[Phase.explicit, Phase.generate])
    settings.load_profile("once")  # the tests' profile inherits from it
    words = ["-x", "-q", "-p", "no:cacheprovider", "--hypothesis-seed=0", f"--basetemp={folder}", *options, *tests]
    return int(pytest.main(words, plugins=[plugin] if plugin else []))


def apart(log: Path) -> int:
    """Fork; send the output of the child, which leads its own group, to a file."""
    if (child := os.fork()) == 0:
        os.setsid()
        out = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(out, 1)
        os.dup2(out, 2)
        resource.setrlimit(resource.RLIMIT_AS, (16 << 30, 16 << 30))  # a mutant may loop and allocate forever
    return child


def observed(file: Path, tests: Sequence[str], folder: Path) -> Watch:
    """Watch the quick tests without a mutant; import their modules, so that the forks need not."""
    notes = folder / "notes.json"
    if (child := apart(folder / "log")) == 0:
        watch = Watch(file)
        code = ask(tests, folder / "base", plugin=watch)
        notes.write_text(json.dumps([watch.seconds, watch.called, [*sys.modules]]))
        os._exit(code)
    if os.waitpid(child, 0)[1]:
        sys.exit(f"the tests fail without any mutant:\n{(folder / 'log').read_text()[-2_000:]}")
    watch = Watch(file)
    watch.seconds, watch.called, modules = json.loads(notes.read_text())
    for name in modules:
        if name.partition(".")[0] not in ("atlantis_exp", "benchmarks", "conftest", "examples", "tests"):
            with suppress(Exception):
                import_module(name)
    return watch


def run_mutated(module: str, tree: ast.Module, mutant: Mutant | None, tests: Sequence[str], folder: Path) -> NoReturn:
    if mutant is not None:
        mutant.apply()
    get_code = SourceFileLoader.get_code

    def mutated(self: SourceFileLoader, name: str) -> Any:
        if name == module:
            return compile(ast.fix_missing_locations(tree), self.path, "exec")
        return get_code(self, name)

    SourceFileLoader.get_code = mutated  # type: ignore[method-assign, assignment]
    os._exit(ask(tests, folder, "-m", ""))


def killed_of(module: str, sample: int, seed: int, folder: Path) -> dict[str, Any]:
    """Run a sample of a module's mutants and print the fate of each."""
    path = ROOT / "atlantis_exp" / f"{module.replace('.', '/')}.py"
    names = [name.rpartition(".") for name in (module, *ALSO.get(module, ()))]
    files = [str(Path("tests", *package.split("."), f"test_{name}.py")) for package, _, name in names]
    watch = observed(path, files, folder)
    tree = ast.parse(path.read_text())
    listed = (Path(__file__).with_name("equivalent_mutants.txt")).read_text().splitlines()
    equivalent = {line.partition("  # ")[0] for line in listed}
    mutants = [each for each in mutants_of(tree) if f"{module}: {each.change}" not in equivalent]
    chosen = random.Random(seed).sample(mutants, min(sample, len(mutants)))
    by_cost = sorted(watch.seconds, key=watch.seconds.__getitem__)
    latest_first = sorted(chosen, key=lambda each: -each.line)
    waiting: list[Mutant | None] = [*latest_first, None]  # the original first
    running: dict[int, tuple[Mutant | None, float, Path]] = {}
    survivors: list[str] = []
    try:
        while waiting or running:
            is_alone = any(mutant is None for mutant, _, _ in running.values())  # the original
            if waiting and len(running) < (os.cpu_count() or 1) and not is_alone:
                mutant = waiting.pop()
                lines = range(mutant.first, mutant.last + 1) if mutant else ()
                tests = [test for test in by_cost if any(line in lines for line in watch.called[test])] or by_cost
                own = Path(tempfile.mkdtemp(dir=folder))
                if (child := apart(own / "log")) == 0:
                    run_mutated(f"atlantis_exp.{module}", tree, mutant, tests, own / "base")
                running[child] = mutant, time.monotonic() + 20 + 5 * sum(watch.seconds[test] for test in tests), own
                continue
            child, status = os.waitpid(-1, os.WNOHANG)
            if not child:
                for late in [pid for pid, (_, deadline, _) in running.items() if time.monotonic() > deadline]:
                    os.killpg(late, signal.SIGKILL)
                time.sleep(0.02)
                continue
            mutant, _, own = running.pop(child)
            if mutant is None and status:
                sys.exit(f"the tests fail on the original:\n{(own / 'log').read_text()[-2_000:]}")
            if mutant is not None:
                print(f"{'killed  ' if status else 'SURVIVED'} {module}:{mutant.line}  {mutant.change}", flush=True)
                survivors += [] if status else [f"{mutant.line}: {mutant.change}"]
            shutil.rmtree(own, ignore_errors=True)
    finally:
        for child in running:
            with suppress(ProcessLookupError):  # it does not lead its group yet
                os.killpg(child, signal.SIGKILL)
    share = 1 - len(survivors) / max(len(chosen), 1)
    return {"module": module, "of": len(mutants), "run": len(chosen), "killed": round(share, 3), "survivors": survivors}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("modules", nargs="*", default=MODULES, help="as training.trainer")
    parser.add_argument("--sample", type=int, default=10_000, help="mutants of each module, at most")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    asked = parser.parse_args()
    os.chdir(ROOT)
    scores = []
    for module in asked.modules:
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            scores.append(killed_of(module, asked.sample, asked.seed, Path(folder)))
    print(json.dumps({"scores": scores}))
    sys.exit(any(score["killed"] < LEAST for score in scores))


if __name__ == "__main__":
    main()
