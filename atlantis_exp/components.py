"""Look up components by kind and name: the built-in classes that a config can name, and those of plugins.

Only the command line admits a plugin, which is then imported; a file or a server cannot. A built-in class is imported
when it is built: `built_in` declares its settings, so that a config is checked without torch.
"""

import hashlib
import inspect
import json
import math
import re
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import MISSING, dataclass, fields
from functools import cache, partial
from importlib import import_module
from importlib.metadata import Distribution, PackageNotFoundError, distribution, entry_points
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType, NoneType, UnionType
from typing import Annotated, Any, Final, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from annotated_types import Interval
from pydantic import TypeAdapter, ValidationError

from atlantis_exp.checking import absolute, nearest
from atlantis_exp.faults import ConfigError, Fault
from atlantis_exp.games import Game

C = TypeVar("C", bound=type)

ENTRY_POINTS: Final = "atlantis_exp.plugins"
"""The group of entry points that name an installed distribution's modules with components."""
NAME: Final = r"^[a-z][a-z0-9_]{0,39}$"
"""The form of a component's or a setting's name: they become run folders and config keys."""

# Ranges of settings.
Count = Annotated[int, Interval(ge=1, le=10**12)]
Positive = Annotated[float, Interval(gt=0, le=1_000)]
Probability = Annotated[float, Interval(ge=0, le=1)]
Share = Annotated[float, Interval(gt=0, lt=1)]
# Types of settings of built-in classes that need torch or numpy.
Oversample = Annotated[int, Interval(ge=2, le=64)]
Quantiles = Annotated[int, Interval(ge=1, le=1_000)]  # an update holds N x N differences per sample
Units = Annotated[int, Interval(ge=1, le=4_096)]
Steps = Annotated[int, Interval(ge=1, le=256)]  # an update holds the frames of every step
Rescaling = Literal["signed_sqrt", "symlog"]


@dataclass(frozen=True)
class _NoFacts:
    pass


@dataclass(frozen=True)
class _NetworkFacts:
    input_size: int = 84  # pixels per side that it is made for
    smallest_side: int = 1  # pixels
    splits_batches: bool = False  # whether the output for a sample depends on that sample alone


@dataclass(frozen=True)
class _ObjectiveFacts:
    head: Literal["plain", "quantile"] = "plain"  # of the network; plain includes dueling


@dataclass(frozen=True)
class Kind:
    """A kind of component: the contract of its classes."""

    given: int = 0  # constructor arguments before the settings
    facts: type = _NoFacts  # class attributes, with their defaults
    methods: tuple[str, ...] = ()  # with their arguments


_SCHEDULE: Final = Kind(methods=("__call__(progress, steps)",))
KINDS: Final = {
    "model": Kind(given=3, facts=_NetworkFacts, methods=("forward(x)",)),  # input_shape, num_actions, head
    "sampler": Kind(
        methods=("sample(memory, batch_size, rng)", "feed_back(ids, errors)", "state_dict()", "load_state_dict(state)")
    ),
    "objective": Kind(
        facts=_ObjectiveFacts,
        methods=("targets(r_t, s_tpm, discount, online, target)", "losses(q, a_t, target)"),
    ),
    "epsilon": _SCHEDULE,
    "lr_schedule": _SCHEDULE,
    "env": Kind(facts=Game),
}
"""The kinds of components. Each is also a config group."""


@dataclass(frozen=True)
class Plugin:
    """A file or an installed distribution with components."""

    name: str  # the file's stem, or the distribution
    version: str | None  # of the distribution
    sha256: str  # of the file, or of all files of its packages
    shown: str  # as on the command line
    roots: tuple[Path, ...]  # the file, or the folders of its packages
    text: bytes | None = None  # of the file

    def __str__(self) -> str:
        return describe(self.name, self.version, self.sha256)

    @contextmanager
    def blamed(self, place: str) -> Iterator[None]:
        """Turn any error except a Fault into a ConfigError with the plugin's file and line, or else `place`."""
        try:
            yield
        except Fault:
            raise
        except (Exception, SystemExit) as error:
            frames = [(each.filename, each.lineno) for each in traceback.extract_tb(error.__traceback__)]
            if isinstance(error, SyntaxError):
                frames.append((error.filename or "", error.lineno))
            own = [f"{name}:{line}" for name, line in frames if {Path(name), *Path(name).parents} & {*self.roots}]
            reason = error.msg if isinstance(error, SyntaxError) else " ".join(str(error).split())
            raise ConfigError(f"{own[-1] if own else place}: {type(error).__name__}: {reason}") from error


@dataclass(frozen=True)
class Setting:
    """An argument of a component's constructor."""

    name: str
    type: Any  # with its range
    default: Any  # MISSING: the setting is required


@dataclass(frozen=True, eq=False)
class Component:
    """A class that a config can name."""

    kind: str
    name: str
    path: Path  # of its source
    line: int
    settings: tuple[Setting, ...]
    facts: Mapping[str, Any]
    load: Callable[[], type[Any]]  # imports it
    plugin: Plugin | None = None  # None: built in

    def data_path(self, name: str) -> Path:
        """Return the path of a file next to the source: for `pong` and `scores.csv`, `pong_scores.csv`."""
        return self.path.with_name(f"{self.name}_{name}")

    def blamed(self) -> AbstractContextManager[None]:
        """Turn an error of a plugin's code into a ConfigError with its file and line."""
        return self.plugin.blamed(f"{self.path}:{self.line}") if self.plugin else nullcontext()


def component(name: str, *kinds: str) -> Callable[[C], C]:
    """Make a plugin's class a component of these kinds: `@component("mynet", "model")`."""
    if not re.fullmatch(NAME, name):
        raise ValueError(f"'{name}': a name has lowercase letters, digits and underscores, at most 40")
    for kind in kinds or ("",):
        if kind not in KINDS:
            raise ValueError(f"'{kind}': no such kind; {nearest(kind, KINDS)}")
    line = sys._getframe(1).f_lineno

    def named(cls: C) -> C:
        cls.__component__ = name, kinds, line  # type: ignore[attr-defined]
        return cls

    return named


def describe(name: str, version: str | None, sha256: str) -> str:
    """Return a plugin's name for people: `mynet 0.3, sha 1a2b3c4d5e6f`."""
    return f"{name}{f' {version}' if version else ''}, sha {sha256[:12]}"


@cache
def built_in() -> Mapping[tuple[str, str], Component]:
    """Return the built-in components by kind and name."""
    rescaled: dict[str, Any] = {"rescaling": Rescaling}
    sequences: dict[str, Any] = {"units": Units, "burn_in": Steps, "unroll": Steps}
    quantiles: dict[str, Any] = {"quantiles": Quantiles, "head": "quantile"}
    ours = [
        _ours("model", "cnn", "networks.cnn.DQNCnn", smallest_side=36, splits_batches=True),
        _ours("model", "cnn_gru", "networks.cnn_gru.DQNCnnGru", smallest_side=36, splits_batches=True, **sequences),
        _ours("model", "cnn_norm", "networks.cnn_norm.NormedCnn", smallest_side=36, splits_batches=True),
        _ours("model", "cnn_small", "networks.cnn_small.SmallCnn", smallest_side=20, splits_batches=True),
        _ours("model", "resnet", "networks.resnet.ResNetDQN", smallest_side=15),
        _ours("model", "resnet_fast", "networks.resnet_fast.ResNetFast", smallest_side=8, splits_batches=True),
        _ours("sampler", "uniform", "replay.samplers.UniformSampler"),
        _ours("sampler", "top_half", "replay.samplers.TopHalfSampler", oversample=Oversample),
        _ours("sampler", "prioritized", "replay.samplers.PrioritizedSampler", alpha=Probability, beta=Probability),
        _ours("objective", "dqn", "learning.objectives.DQN"),
        _ours("objective", "double_dqn", "learning.objectives.DoubleDQN"),
        _ours("objective", "quantile", "learning.objectives.Quantile", **quantiles),
        _ours("objective", "double_quantile", "learning.objectives.DoubleQuantile", **quantiles),
        _ours("objective", "rescaled_double_dqn", "learning.objectives.RescaledDoubleDQN", **rescaled),
        _ours("objective", "rescaled_quantile", "learning.objectives.RescaledQuantile", **quantiles, **rescaled),
        _ours("epsilon", "constant", "learning.schedules.Constant"),
        _ours("epsilon", "linear", "learning.schedules.Linear"),
        _ours("epsilon", "linear_steps", "learning.schedules.LinearSteps"),
        _ours("epsilon", "exponential", "learning.schedules.Exponential"),
        _ours("lr_schedule", "constant", "learning.schedules.Constant"),
        _ours("lr_schedule", "linear", "learning.schedules.Linear"),
        _ours("lr_schedule", "one_cycle", "learning.schedules.OneCycle"),
        _ours("env", "atlantis", "game.atlantis.Atlantis"),
    ]
    return {(each.kind, each.name): each for each in ours}


def _ours(kind: str, name: str, place: str, **declared: Any) -> Component:
    """Return a built-in component with its declared settings and facts; read those of a class that imports fast."""
    module, _, class_name = place.rpartition(".")

    def load() -> type[Any]:
        loaded: type[Any] = getattr(import_module(f"atlantis_exp.{module}"), class_name)
        return loaded

    if kind in ("epsilon", "lr_schedule", "env"):
        settings, facts = read(kind, load())
    else:
        facts = {each.name: declared.pop(each.name, each.default) for each in fields(KINDS[kind].facts)}
        settings = tuple(Setting(each, told, MISSING) for each, told in declared.items())
    path = Path(__file__).parent.joinpath(*module.split(".")).with_suffix(".py")
    return Component(kind, name, path, 1, settings, facts, load)


def read(kind: str, cls: type[Any]) -> tuple[tuple[Setting, ...], dict[str, Any]]:
    """Return the settings and facts of a class. Raises: TypeError if it breaks the contract of its kind."""
    named = [each for each in fields(KINDS[kind].facts) if each.name not in ("rom", "points")]
    facts = {each.name: getattr(cls, each.name, each.default) for each in named}
    return tuple(_settings(KINDS[kind].given, cls)), facts


def _settings(count: int, cls: type[Any]) -> Iterator[Setting]:
    arguments = [*inspect.signature(cls).parameters.values()]
    given = [each for each in arguments if each.kind in (each.POSITIONAL_ONLY, each.POSITIONAL_OR_KEYWORD)]
    if len(given) < count and not any(each.kind == each.VAR_POSITIONAL for each in arguments):
        raise TypeError(f"__init__ takes {len(given)} arguments but gets {count}")
    types = get_type_hints(cls.__init__, include_extras=True)
    for each in arguments:
        if each in given[:count] or each.kind in (each.VAR_POSITIONAL, each.VAR_KEYWORD):
            continue
        if not re.fullmatch(NAME, each.name) or each.name in _TAKEN:
            raise TypeError(
                f"{each.name}: a setting has lowercase letters, digits and underscores, and is not one of "
                f"{', '.join(_TAKEN)}"
            )
        if each.name not in types:
            raise TypeError(f"{each.name}: has no type; write {each.name}: int")
        if not _is_plain(types[each.name]):
            raise TypeError(
                f"{each.name}: {inspect.formatannotation(each.annotation)} cannot be a setting's type; use int, "
                "float, bool, str, Literal[...], tuple[...], one of these | None, Annotated[int, Interval(ge=1)]"
            )
        yield Setting(each.name, types[each.name], MISSING if each.default is each.empty else each.default)


def _check(kind: str, cls: type[Any], settings: Sequence[Setting], facts: Mapping[str, Any]) -> None:
    """Raise TypeError for defaults, facts or signatures of a plugin's class that would fail later."""
    for each in settings:
        if each.default is not MISSING:
            try:
                TypeAdapter(each.type).validate_json(json.dumps(each.default), strict=True)
            except ValidationError as error:
                raise TypeError(f"{each.name}: default {each.default!r}: {error.errors()[0]['msg']}") from None
    for name, value in facts.items():
        told = KINDS[kind].facts.__annotations__[name]
        try:
            TypeAdapter(told).validate_python(value, strict=True)
        except ValidationError:
            raise TypeError(f"{name}: should be a {inspect.formatannotation(told)}, not {value!r}") from None
    for signature in KINDS[kind].methods:
        method, *arguments = re.findall(r"\w+", signature)
        found = next((vars(each)[method] for each in cls.__mro__ if method in vars(each)), None)
        try:
            inspect.signature(found).bind("self", *arguments)  # type: ignore[arg-type]
        except TypeError:
            raise TypeError(f"needs a method {method}({', '.join(['self', *arguments])})") from None
    quantiles = {each.name: each.type for each in settings}.get("quantiles")
    if facts.get("head") == "quantile" and getattr(quantiles, "__origin__", quantiles) is not int:
        raise TypeError('head = "quantile" needs a setting quantiles: int')
    if kind == "env":
        _check_game(cls, settings)


def _check_game(cls: type[Any], settings: Sequence[Setting]) -> None:
    if settings:
        raise TypeError(f"{settings[0].name}: a game takes no settings; they belong in conf/env")
    for fact, example in (("actions", '("NOOP", "FIRE")'), ("score_range", "(0.0, 400.0)")):
        if not hasattr(cls, fact):
            raise TypeError(f"{fact}: missing; write {fact} = {example}")
    low, high = cls.score_range
    if not -math.inf < low < high < math.inf:
        raise TypeError(f"score_range: should be the lowest and the highest score, not ({low}, {high})")
    for source in getattr(cls, "sources", ()):
        if not re.fullmatch(r"\w[\w.\- ]{0,99}", source, re.ASCII):  # it names a metric
            raise TypeError(f"sources: '{source}' should have letters, digits and '_.- ' only")
    if getattr(cls, "sources", ()):
        try:
            inspect.signature(getattr(cls, "points", None)).bind("reward", "ram")  # type: ignore[arg-type]
        except TypeError:
            raise TypeError(
                "sources: need a static method points(reward, ram) that returns the points of each"
            ) from None


def _is_plain(told: Any) -> bool:
    """Return whether values of a type can be written in YAML and stored as JSON."""
    parts = get_args(told)
    match get_origin(told):
        case None:
            return told in (int, float, bool, str, NoneType, ...)
        case origin if origin is Annotated:
            return _is_plain(parts[0])
        case origin if origin is Literal:
            return all(isinstance(each, bool | int | float | str | None) for each in parts)
        case origin:
            return origin in (Union, UnionType, tuple) and all(map(_is_plain, parts))


_TAKEN = ("component", "defaults", "name", "own", "settings")
"""Keys of every component's config."""


_references: tuple[str, ...] = ()
_admitted: Mapping[tuple[str, str], Component] = {}


def admit(references: Sequence[str]) -> None:
    """Import the plugins that a command line names, and drop those admitted before.

    references: files such as ./mynet.py, or names of installed distributions. The same references are read only once,
    so that a sweep trains one version.

    Raises: ConfigError if a plugin cannot be imported or breaks a contract, or a name is taken.
    """
    global _references, _admitted
    if (given := tuple(references)) == _references:
        return
    _references, _admitted = (), {}
    plugins: dict[str, str] = {}
    found: dict[tuple[str, str], Component] = {}
    for reference in given:
        plugin, loads = _plugin(reference)
        if (other := plugins.setdefault(plugin.name, reference)) != reference:
            raise ConfigError(f"plugins={reference}: {other} is called {plugin.name}, too; rename one")
        offered = [each for load in loads for each in _components(plugin, load)]
        if not offered:
            raise ConfigError(
                f'plugins={reference}: has no component; put @component("NAME", "KIND") before a class '
                f"(kinds: {', '.join(KINDS)})"
            )
        for each in offered:
            where, what = f"{each.path}:{each.line}", f"{each.kind}={each.name}"
            if (each.kind, each.name) in built_in():
                raise ConfigError(f"{where}: {what} is built in and cannot be replaced; rename yours")
            taken = found.setdefault((each.kind, each.name), each)
            if taken.load() is not each.load():
                raise ConfigError(f"{where}: {what} is also in {taken.path}; rename one of them")
    _references, _admitted = given, found


def admitted() -> Mapping[tuple[str, str], Component]:
    """Return the components of the plugins that the command line names."""
    return _admitted


def known(kind: str) -> dict[str, Component]:
    """Return the components of a kind by name, ours and the admitted plugins'."""
    return {name: found for (of, name), found in {**built_in(), **admitted()}.items() if of == kind}


def game_ids(name: str) -> tuple[str, str]:
    """Return Gymnasium's two ids of a game: for `pong`, Pong-v0 and ALE/Pong-v5."""
    title = name.title().replace("_", "")
    return f"{title}-v0", f"ALE/{title}-v5"


def game_of(env_id: str) -> Component | None:
    """Return the game that one of Gymnasium's ids names, None if it is unknown."""
    return next((game for name, game in known("env").items() if env_id in game_ids(name)), None)


def title_of(env_id: str) -> str:
    """Return the title of the game that one of Gymnasium's ids names: for ALE/Pong-v5, Pong."""
    return env_id.rpartition("/")[2].partition("-v")[0]


def facts_of(game: Component | None) -> Game:
    """Return the facts of a game, without its code; the defaults for an unknown one."""
    return Game() if game is None else Game(rom=game.name, **game.facts)


def points_of(game: Component) -> Callable[[int, Any], Sequence[float]]:
    """Return the function that splits a frame's reward; it can be sent to worker processes."""
    cls = game.load()
    points: Callable[[int, Any], Sequence[float]] = cls.points
    text = game.plugin.text if game.plugin else None
    return points if text is None else partial(_points, game.path, text, cls.__name__)


def _points(path: Path, text: bytes, class_name: str, reward: int, ram: Any) -> Sequence[float]:
    """Split a frame's reward in a process that cannot import the plugin's file."""
    points: Sequence[float] = getattr(_load(path, text), class_name).points(reward, ram)
    return points


def _load(path: Path, text: bytes) -> ModuleType:
    """Return a file's module, run once from the bytes that were hashed."""
    name = f"atlantis_exp_plugin_{path.stem}"
    own = {"__file__": str(path), "__text__": text}
    if (loaded := sys.modules.get(name)) is not None and own.items() <= vars(loaded).items():
        return loaded
    loaded = ModuleType(name)
    vars(loaded).update(own)
    code = compile(text, str(path), "exec")
    sys.modules[name] = loaded  # dataclasses look up the types of their fields here
    try:
        exec(code, vars(loaded))
    except BaseException:
        del sys.modules[name]
        raise
    return loaded


def installed() -> dict[str, list[str]]:
    """Return the component names of each installed distribution; import nothing."""
    offered: dict[str, list[str]] = {}
    for point in entry_points(group=ENTRY_POINTS):
        if point.dist is not None:
            offered.setdefault(point.dist.name, []).append(point.name)
    return offered


def _components(plugin: Plugin, load: Callable[[], ModuleType]) -> Iterator[Component]:
    """Import a module of a plugin and return its classes with `@component`."""
    with plugin.blamed(f"plugins={plugin.shown}"):
        module = load()
    top = module.__name__.partition(".")[0]
    for cls in vars(module).values():
        # Skip imported classes, and subclasses of components.
        if isinstance(cls, type) and cls.__module__.partition(".")[0] == top and "__component__" in vars(cls):
            name, kinds, line = vars(cls)["__component__"]
            path = Path(str(sys.modules[cls.__module__].__file__))
            for kind in kinds:
                with plugin.blamed(f"{path}:{line}"):
                    settings, facts = read(kind, cls)
                    _check(kind, cls, settings, facts)
                yield Component(kind, name, path, line, settings, facts, lambda cls=cls: cls, plugin)  # type: ignore[misc]


def _plugin(reference: str) -> tuple[Plugin, list[Callable[[], ModuleType]]]:
    """Return a plugin, not yet imported, and the functions that import its modules."""
    if "/" in reference or reference.endswith(".py"):
        path = absolute("plugins", reference)
        if not re.fullmatch(r"[A-Za-z_]\w{0,79}", path.stem, re.ASCII) or path.suffix != ".py":
            raise ConfigError(f"plugins={reference}: name a file NAME.py, with letters, digits and underscores in NAME")
        text = _read(reference, path)
        plugin = Plugin(path.stem, None, hashlib.sha256(text).hexdigest(), reference, (path,), text)
        return plugin, [partial(_load, path, text)]
    try:
        package = distribution(reference)
    except (PackageNotFoundError, ValueError):
        names = installed()
        hint = nearest(reference, names) if names else "write a file with its ending, as in ./mynet.py"
        raise ConfigError(f"plugins={reference}: no such distribution is installed; {hint}") from None
    return _package(reference, package)


def _package(reference: str, package: Distribution) -> tuple[Plugin, list[Callable[[], ModuleType]]]:
    """Do the same for a distribution, hashed over the packages that its entry points name."""
    modules = sorted({point.module for point in package.entry_points.select(group=ENTRY_POINTS)})
    if not modules:
        raise ConfigError(f"plugins={reference}: it has no entry point in the group {ENTRY_POINTS}")
    hashed, roots = hashlib.sha256(), []
    for top in sorted({module.partition(".")[0] for module in modules}):
        spec = find_spec(top)  # imports nothing for a top-level name
        if spec is None or spec.origin is None or not spec.origin.endswith(".py"):
            raise ConfigError(f"plugins={reference}: its entry point names {top}, whose source is missing")
        path = Path(spec.origin)
        is_package = path.name == "__init__.py"
        roots.append(path.parent if is_package else path)
        for file in sorted(path.parent.rglob("*.py")) if is_package else [path]:
            hashed.update(f"{top}/{file.relative_to(path.parent)}\0".encode())
            hashed.update(hashlib.sha256(_read(reference, file)).digest())
    plugin = Plugin(package.name, package.version, hashed.hexdigest(), reference, tuple(roots))
    return plugin, [partial(import_module, module) for module in modules]


def _read(reference: str, path: Path) -> bytes:
    if not path.is_file():
        raise ConfigError(f"plugins={reference}: {path} is not a file")
    try:
        return path.read_bytes()
    except OSError as error:
        raise ConfigError(f"plugins={reference}: {error}") from None
