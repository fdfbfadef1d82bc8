"""Components by kind and name, ours and those of plugins: what a class takes, and what it says of itself.

All of it is read from sources, never by importing them: a class is imported when it is built. Of plugins, those alone
count that were admitted, which the command line does and nothing that is read from disk or from a server.
"""

import ast
import hashlib
import math
import re
import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, fields
from functools import cache
from importlib import import_module
from importlib.metadata import Distribution, PackageNotFoundError, distribution, distributions
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, Final, Literal

from annotated_types import Interval
from pydantic import TypeAdapter, ValidationError

from atlantis_exp.checking import absolute, nearest
from atlantis_exp.faults import ConfigError, Fault
from atlantis_exp.registry import Game
from atlantis_exp.registry import component as component

ENTRY_POINTS: Final = "atlantis_exp.plugins"
"""The group of the entry points by which an installed distribution names its modules with components."""
NAME: Final = r"^[a-z][a-z0-9_]{0,39}$"
"""What a component and a setting may be called: run folders and config keys are made of it."""

_OURS = Path(__file__).resolve().parent
_PLACES = ("networks/*.py", "replay/samplers.py", "learning/objectives.py", "learning/schedules.py", "game/*.py")
_MOST_BYTES = 1_000_000  # of a source
_MOST_FILES = 10_000  # of a package
_PLAIN = {"int": int, "float": float, "bool": bool, "str": str}


@dataclass(frozen=True)
class Kind:
    """A kind of component: what its constructor is given besides settings, and what its classes may say."""

    given: int = 0  # arguments, the first ones of the constructor
    facts: Mapping[str, Any] | None = None  # class attributes, with the value of a class that is silent


KINDS: Final = {
    "model": Kind(
        given=3,  # input_shape, num_actions, head
        facts={
            "input_size": 84,  # pixels a side that it is made for
            "smallest_side": 1,  # pixels
            "splits_batches": False,  # whether what it makes of a sample depends on that sample alone
        },
    ),
    "sampler": Kind(),
    "objective": Kind(facts={"head": "plain"}),  # that a network needs: plain, which dueling is too, or quantile
    "epsilon": Kind(),
    "lr_schedule": Kind(),
    "env": Kind(facts={each.name: each.default for each in fields(Game) if each.name not in ("rom", "points")}),
}
"""The kinds of components, which are config groups, too."""


@dataclass(frozen=True)
class Plugin:
    """Where components come from that are not ours: a file, or an installed distribution."""

    name: str  # of the file without its ending, or of the distribution
    version: str | None  # of the distribution
    sha256: str  # of the file, or of all of the package's
    shown: str  # as on the command line

    def __str__(self) -> str:
        return describe(self.name, self.version, self.sha256)


@dataclass(frozen=True)
class Setting:
    """An argument of a component's constructor."""

    name: str
    type: Any  # with its range
    default: Any  # MISSING where there is none


@dataclass(frozen=True, eq=False)
class Component:
    """A class that a config can name."""

    kind: str
    name: str
    class_name: str
    settings: tuple[Setting, ...]
    facts: Mapping[str, Any]
    source: "Source"
    line: int

    @property
    def plugin(self) -> Plugin | None:
        """The plugin that it is of; None where it is ours."""
        return self.source.plugin

    def load(self) -> type[Any]:
        """Import the class. Raises: ConfigError where a plugin fails, naming file and line."""
        with self.blamed():
            loaded: type[Any] = getattr(self.source.load(), self.class_name)
        return loaded

    def data_path(self, name: str) -> Path:
        """The path of a file that comes with it: of `pong` and `scores.csv`, `pong_scores.csv` next to it."""
        return self.source.path.with_name(f"{self.name}_{name}")

    @contextmanager
    def blamed(self) -> Iterator[None]:
        """Turn what a plugin's code raises into one line that names its file and line. Raises: ConfigError."""
        try:
            yield
        except Fault:
            raise
        except (Exception, SystemExit) as error:
            if self.plugin is None:
                raise
            lines = [
                frame.lineno
                for frame in traceback.extract_tb(error.__traceback__)
                if frame.filename == str(self.source.path)
            ]
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise ConfigError(f"{self.source.path}:{lines[-1] if lines else self.line}: {reason}") from error


@dataclass(frozen=True)
class Method:
    """A static method of a plugin's class that other processes can be sent: they load its source anew."""

    component: Component
    name: str

    def __call__(self, *given: Any) -> Any:
        return getattr(self.component.load(), self.name)(*given)


@dataclass(frozen=True)
class Source:
    """A module with components, as it is on disk."""

    path: Path
    text: bytes
    module: str | None  # to import; None: it is a file alone, and its text is run
    plugin: Plugin | None = None

    def load(self) -> ModuleType:
        """Import it, a file alone as the very text that was read and hashed."""
        if self.module is not None:
            return import_module(self.module)
        assert self.plugin is not None
        name = f"atlantis_exp_plugin_{self.plugin.name}"
        loaded = sys.modules.get(name)
        if loaded is not None and getattr(loaded, "__sha256__", None) == self.plugin.sha256:
            return loaded
        spec = spec_from_loader(name, loader=None, origin=str(self.path))
        assert spec is not None
        loaded = module_from_spec(spec)
        loaded.__file__, loaded.__dict__["__sha256__"] = str(self.path), self.plugin.sha256
        code = compile(self.text, str(self.path), "exec")
        sys.modules[name] = loaded  # where dataclasses look for the types of their fields
        try:
            exec(code, loaded.__dict__)
        except BaseException:
            del sys.modules[name]
            raise
        return loaded

    def components(self) -> list[Component]:
        """The classes that `component` names. Raises: ConfigError with file and line for what cannot be read."""
        try:
            tree = ast.parse(self.text, str(self.path))
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            line = getattr(error, "lineno", None) or 1
            reason = getattr(error, "msg", None) or str(error) or type(error).__name__
            raise ConfigError(f"{self.path}:{line}: {type(error).__name__}: {reason}") from None
        try:
            return [*_Reader(self, tree).components()]
        except RecursionError:
            raise ConfigError(f"{self.path}:1: a class or a type in it is made of itself") from None


def describe(name: str, version: str | None, sha256: str) -> str:
    """What people call a plugin: `mynet 0.3, sha 1a2b3c4d5e6f`."""
    return f"{name}{f' {version}' if version else ''}, sha {sha256[:12]}"


@cache
def built_in() -> Mapping[tuple[str, str], Component]:
    """Our own components by kind and name."""
    sources = []
    for path in sorted(path for place in _PLACES for path in _OURS.glob(place)):
        module = ".".join(("atlantis_exp", *path.relative_to(_OURS).with_suffix("").parts))
        sources.append(Source(path, path.read_bytes(), module))
    return {(found.kind, found.name): found for source in sources for found in source.components()}


@dataclass(frozen=True)
class _Admitted:
    references: tuple[str, ...] = ()
    components: Mapping[tuple[str, str], Component] | None = None


_admitted = _Admitted()


def admit(references: Sequence[str]) -> None:
    """Let the plugins that a command line names, and no others, count in this process; none is imported.

    references: files, as ./mynet.py, or names of installed distributions. A file is read once, however often it is
    admitted in a row: what changes amid a sweep counts from the next command on.

    Raises:
        ConfigError: for a plugin that cannot be read, and for a name that is taken.
    """
    global _admitted
    if (given := tuple(references)) == _admitted.references:
        return
    _admitted = _Admitted()
    plugins: dict[str, str] = {}
    found: dict[tuple[str, str], Component] = {}
    for reference in given:
        for source in _sources(reference):
            assert source.plugin is not None
            if (other := plugins.setdefault(source.plugin.name, reference)) != reference:
                raise ConfigError(f"plugins={reference}: {other} is called {source.plugin.name}, too; rename one")
            for each in source.components():
                key = each.kind, each.name
                if key in built_in():
                    raise ConfigError(
                        f"{source.path}:{each.line}: {each.kind}={each.name} is built in and is not replaced; "
                        "give yours another name"
                    )
                if (taken := found.setdefault(key, each)) is not each:
                    raise ConfigError(
                        f"{source.path}:{each.line}: {each.kind}={each.name} is {taken.source.path}'s, too; "
                        "give one of them another name"
                    )
        if not any(each.plugin and each.plugin.shown == reference for each in found.values()):
            raise ConfigError(
                f'plugins={reference}: names no component; put @component("NAME", "KIND") before a class, '
                f"KIND being one of {', '.join(KINDS)}"
            )
    _admitted = _Admitted(given, found)


def admitted() -> Mapping[tuple[str, str], Component]:
    """The components of the plugins that the command line names."""
    return _admitted.components or {}


def known(kind: str) -> dict[str, Component]:
    """The components of a kind by name, ours and the admitted plugins'."""
    return {name: found for (of, name), found in {**built_in(), **admitted()}.items() if of == kind}


def game_ids(name: str) -> tuple[str, str]:
    """Gymnasium's two ids of a game: of `pong`, Pong-v0 and ALE/Pong-v5."""
    title = name.title().replace("_", "")
    return f"{title}-v0", f"ALE/{title}-v5"


def game_of(env_id: str) -> Component | None:
    """The game that one of Gymnasium's ids names; None where it is a plugin's that no command line names."""
    return next((game for name, game in known("env").items() if env_id in game_ids(name)), None)


def title_of(env_id: str) -> str:
    """What people call the game of one of Gymnasium's ids: of ALE/Pong-v5, Pong."""
    return env_id.rpartition("/")[2].partition("-v")[0]


def facts_of(game: Component | None) -> Game:
    """What a game says of itself, without its code; of one that is not known, nothing."""
    return Game() if game is None else Game(rom=game.name, **game.facts)


def installed() -> dict[str, list[Component]]:
    """What the distributions offer that are installed, by their names; nothing is imported.

    A distribution whose sources cannot be read offers nothing: whoever admits it reads why.
    """
    offered: dict[str, list[Component]] = {}
    for each in distributions():
        if each.entry_points.select(group=ENTRY_POINTS):
            try:
                sources = _sources_of(each.name, each)
                offered[each.name] = [found for source in sources for found in source.components()]
            except ConfigError:
                continue
    return offered


def _sources(reference: str) -> list[Source]:
    if "/" in reference or reference.endswith(".py"):
        return [_file(reference)]
    try:
        package = distribution(reference)
    except (PackageNotFoundError, ValueError):
        names = {each.name for each in distributions() if each.entry_points.select(group=ENTRY_POINTS)}
        hint = nearest(reference, names) if names else "a file is written with its ending, as in ./mynet.py"
        raise ConfigError(f"plugins={reference}: no such distribution is installed; {hint}") from None
    return _sources_of(reference, package)


def _file(reference: str) -> Source:
    path = absolute("plugins", reference)
    if not re.fullmatch(r"[A-Za-z_]\w{0,79}", path.stem, re.ASCII) or path.suffix != ".py":
        raise ConfigError(f"plugins={reference}: write a file NAME.py, its name of letters, digits and underscores")
    text = _read(reference, path)
    return Source(path, text, None, Plugin(path.stem, None, hashlib.sha256(text).hexdigest(), reference))


def _sources_of(reference: str, package: Distribution) -> list[Source]:
    """The modules that a distribution's entry points name, with the hash of the packages that hold them."""
    points = package.entry_points.select(group=ENTRY_POINTS)
    modules = sorted({point.module for point in points})
    if not modules:
        raise ConfigError(f"plugins={reference}: it has no entry point in the group {ENTRY_POINTS}")
    hashed = hashlib.sha256()
    for top in sorted({module.partition(".")[0] for module in modules}):
        path = _locate(reference, top)
        files = sorted(path.parent.rglob("*.py")) if path.name == "__init__.py" else [path]
        if len(files) > _MOST_FILES:
            raise ConfigError(f"plugins={reference}: {path.parent} has more than {_MOST_FILES:,} sources")
        for file in files:
            hashed.update(f"{top}/{file.relative_to(path.parent)}\0".encode())
            hashed.update(hashlib.sha256(_read(reference, file)).digest())
    plugin = Plugin(package.name, package.version, hashed.hexdigest(), reference)
    paths = [_locate(reference, module) for module in modules]
    return [Source(path, _read(reference, path), module, plugin) for path, module in zip(paths, modules, strict=True)]


def _locate(reference: str, module: str) -> Path:
    """Where a module's source is; its parents are not imported, as `importlib.util.find_spec` would."""
    folders: Any = None
    origin = None
    parts = module.split(".")
    for end in range(1, len(parts) + 1):
        name = ".".join(parts[:end])
        specs = (finder.find_spec(name, folders) for finder in sys.meta_path if hasattr(finder, "find_spec"))
        if (spec := next((spec for spec in specs if spec is not None), None)) is None:
            raise ConfigError(f"plugins={reference}: its entry point names {module}, which is not there")
        folders, origin = spec.submodule_search_locations, spec.origin
    if origin is None or not origin.endswith(".py"):
        raise ConfigError(f"plugins={reference}: {module} has no source to read")
    return Path(origin)


def _read(reference: str, path: Path) -> bytes:
    try:
        if not path.is_file():
            raise ConfigError(f"plugins={reference}: there is no file {path}")
        with open(path, "rb") as file:
            text = file.read(_MOST_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"plugins={reference}: {error}") from None
    if len(text) > _MOST_BYTES:
        raise ConfigError(f"plugins={reference}: {path} has more than {_MOST_BYTES:,} bytes")
    return text


class _Reader:
    """What a syntax tree says of the components in it."""

    def __init__(self, source: Source, tree: ast.Module) -> None:
        self._source = source
        self._classes = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
        self._aliases = {
            target.id: node.value
            for node in tree.body
            if isinstance(node, ast.Assign)
            for target in node.targets
            if isinstance(target, ast.Name)
        }

    def components(self) -> Iterator[Component]:
        for node in self._classes.values():
            for decorator in node.decorator_list:
                if isinstance(decorator, ast.Call) and _last(decorator.func) == "component":
                    name, *kinds = self._names(decorator)
                    for kind in kinds:
                        settings = tuple(self._settings(node, KINDS[kind]))
                        facts = self._facts(node, KINDS[kind].facts or {})
                        types = {each.name: getattr(each.type, "__origin__", each.type) for each in settings}
                        if facts.get("head") == "quantile" and types.get("quantiles") is not int:
                            raise self._error(node, 'head = "quantile" needs a setting quantiles: int, their number')
                        if kind == "env":
                            self._check_game(node, settings, facts)
                        yield Component(kind, name, node.name, settings, facts, self._source, node.lineno)

    def _check_game(self, node: ast.ClassDef, settings: Sequence[Setting], facts: Mapping[str, Any]) -> None:
        if settings:
            raise self._error(node, f"{settings[0].name}: a game has no settings; they are those of conf/env")
        for fact, example in (("actions", '("NOOP", "FIRE")'), ("score_range", "(0.0, 400.0)")):
            if facts[fact] == KINDS["env"].facts[fact]:  # type: ignore[index]
                raise self._error(node, f"{fact}: missing; write {fact} = {example}")
        for each in fields(Game):
            if each.name in facts:
                told: Any = each.type
                try:
                    TypeAdapter(told).validate_python(facts[each.name], strict=True)
                except ValidationError:
                    raise self._error(node, f"{each.name}: should be a {each.type}") from None
        low, high = facts["score_range"]
        if not -math.inf < low < high < math.inf:
            raise self._error(node, f"score_range: should be the lowest score and the highest, not ({low}, {high})")
        if facts["sources"] and "points" not in self._members(node):
            raise self._error(node, "sources: need a static method points(reward, ram), which says what each has paid")

    def _members(self, node: ast.ClassDef) -> set[str]:
        """The names of what a class defines or assigns, what it inherits from in this file included."""
        members = [member for each in self._lineage(node) for member in each.body]
        assigned = {_last(target) for member in members if isinstance(member, ast.Assign) for target in member.targets}
        return assigned | {member.name for member in members if isinstance(member, ast.FunctionDef)}

    def _names(self, call: ast.Call) -> list[str]:
        names = [argument.value if isinstance(argument, ast.Constant) else None for argument in call.args]
        if len(names) < 2 or call.keywords or not all(isinstance(name, str) for name in names):
            raise self._error(call, 'write @component("NAME", "KIND"), both as plain strings')
        name, *kinds = map(str, names)
        if not re.fullmatch(NAME, name):
            raise self._error(call, f"'{name}': a name is of small letters, digits and underscores, 40 at most")
        for kind in kinds:
            if kind not in KINDS:
                raise self._error(call, f"'{kind}': no such kind; {nearest(kind, KINDS)}")
        return [name, *kinds]

    def _lineage(self, node: ast.ClassDef) -> list[ast.ClassDef]:
        """A class and what it inherits from in this file, nearest last."""
        bases = [self._classes[name] for base in reversed(node.bases) if (name := _last(base)) in self._classes]
        above = [each for base in bases if base is not node for each in self._lineage(base)]
        return [*dict.fromkeys(above), node]

    def _settings(self, node: ast.ClassDef, kind: Kind) -> Iterator[Setting]:
        lineage = self._lineage(node)
        for each in reversed(lineage):
            for member in each.body:
                if isinstance(member, ast.FunctionDef) and member.name == "__init__":
                    yield from self._arguments(member, kind)
                    return
        if kind.given == 0 and any(_last(each) == "dataclass" for above in lineage for each in above.decorator_list):
            fields = {}
            for each in lineage:
                for member in each.body:
                    if (
                        isinstance(member, ast.AnnAssign)
                        and isinstance(member.target, ast.Name)
                        and _last(member.annotation) != "ClassVar"
                    ):
                        fields[member.target.id] = self._setting(
                            member.target.id, member.annotation, member.value, member
                        )
            yield from fields.values()

    def _arguments(self, init: ast.FunctionDef, kind: Kind) -> Iterator[Setting]:
        positional = [*init.args.posonlyargs, *init.args.args][1:]
        if len(positional) < kind.given and init.args.vararg is None:
            raise self._error(init, f"__init__ takes {len(positional)} arguments; it is given {kind.given}")
        padding: list[ast.expr | None] = [None] * (len(positional) - len(init.args.defaults))
        defaults = [*padding, *init.args.defaults][-len(positional) :] if positional else []
        given = [*zip(positional, defaults, strict=True)][kind.given :]
        for argument, default in (*given, *zip(init.args.kwonlyargs, init.args.kw_defaults, strict=True)):
            if argument.annotation is None:
                raise self._error(argument, f"{argument.arg}: has no type; write {argument.arg}: int")
            yield self._setting(argument.arg, argument.annotation, default, argument)

    def _setting(self, name: str, annotation: ast.expr, default: ast.expr | None, node: ast.AST) -> Setting:
        if not re.fullmatch(NAME, name) or name in _TAKEN:
            taken = " or ".join(map(repr, _TAKEN))
            raise self._error(node, f"{name}: a setting is of small letters, digits and underscores, and not {taken}")
        try:
            told = self._type(name, annotation)
        except TypeError:  # Python's own, of Annotated[int] or None | None
            raise self._no_type(name, annotation) from None
        return Setting(name, told, MISSING if default is None else self._value(name, default))

    def _facts(self, node: ast.ClassDef, silent: Mapping[str, Any]) -> dict[str, Any]:
        facts = dict(silent)
        for each in self._lineage(node):
            for member in each.body:
                targets = member.targets if isinstance(member, ast.Assign) else [getattr(member, "target", None)]
                for target in targets:
                    if not isinstance(target, ast.Name) or target.id not in silent:
                        continue
                    value = self._value(target.id, getattr(member, "value", None) or target)
                    if type(value) is not type(silent[target.id]):
                        raise self._error(target, f"{target.id}: should be as in {target.id} = {silent[target.id]!r}")
                    facts[target.id] = value
        if facts.get("head", "plain") not in ("plain", "quantile"):
            raise self._error(node, f"head = {facts['head']!r}: no such head; {nearest(facts['head'], _HEADS)}")
        return facts

    def _value(self, name: str, node: ast.expr) -> Any:
        try:
            if _is_plain(value := ast.literal_eval(node)):
                return value
        except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
            pass
        raise self._error(node, f"{name}: its value should be a number, a text, None, or a tuple of them")

    def _type(self, name: str, node: ast.expr) -> Any:
        """An annotation as a type, from what it says alone."""
        match node:
            case ast.Constant(value=None):
                return None
            case ast.Constant(value=str(text)) if (said := _expression(text)) is not None:
                return self._type(name, said)
            case ast.Name(id=plain) if plain in _PLAIN:
                return _PLAIN[plain]
            case ast.Name(id=alias) if alias in self._aliases:
                return self._type(name, self._aliases[alias])
            case ast.BinOp(left=left, op=ast.BitOr(), right=right):
                return self._type(name, left) | self._type(name, right)
            case ast.Subscript(value=outer, slice=inside):
                parts = inside.elts if isinstance(inside, ast.Tuple) else [inside]
                match _last(outer):
                    case "Literal":
                        return Literal[tuple(self._value(name, part) for part in parts)]
                    case "Optional":
                        return self._type(name, parts[0]) | None
                    case "tuple":
                        inner = (... if _is_dots(part) else self._type(name, part) for part in parts)
                        return tuple.__class_getitem__(tuple(inner))
                    case "Annotated":
                        ranges = [self._range(name, part) for part in parts[1:]]
                        return Annotated[self._type(name, parts[0]), *ranges]
        raise self._no_type(name, node)

    def _no_type(self, name: str, node: ast.expr) -> ConfigError:
        return self._error(
            node,
            f"{name}: {ast.unparse(node)} is no type of a setting; write int, float, bool, str, Literal[...], "
            "tuple[...], one of them or None, or Annotated[int, Interval(ge=1, le=9)]",
        )

    def _range(self, name: str, node: ast.expr) -> Interval:
        if isinstance(node, ast.Call) and _last(node.func) == "Interval" and not node.args:
            bounds = {str(each.arg): self._value(name, each.value) for each in node.keywords}
            if bounds.keys() <= {"gt", "ge", "lt", "le"}:
                return Interval(**bounds)
        raise self._error(node, f"{name}: {ast.unparse(node)} is no range; write Interval(ge=1, le=9), or gt, lt")

    def _error(self, node: ast.AST, reason: str) -> ConfigError:
        return ConfigError(f"{self._source.path}:{getattr(node, 'lineno', 1)}: {reason}")


_HEADS = ("plain", "quantile")
_TAKEN = ("component", "defaults", "name", "own", "settings")
"""What a config says of every component, which no setting may be called."""


def _last(node: ast.expr) -> str:
    """The last part of a name: of `dataclasses.dataclass(frozen=True)`, `dataclass`."""
    match node:
        case ast.Name(id=name) | ast.Attribute(attr=name):
            return name
        case ast.Call(func=inner) | ast.Subscript(value=inner):
            return _last(inner)
    return ""


def _is_plain(value: object) -> bool:
    if isinstance(value, tuple):
        return all(map(_is_plain, value))
    return value is None or isinstance(value, bool | int | float | str)


def _expression(text: str) -> ast.expr | None:
    """An annotation that is written as a string; None where it is no expression."""
    try:
        return ast.parse(text, mode="eval").body
    except (SyntaxError, ValueError, MemoryError, RecursionError):
        return None


def _is_dots(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and node.value is ...
