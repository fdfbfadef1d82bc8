"""Print `--help`: the verbs, or a verb's keys with their comments in conf/; load nothing heavy."""

import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path

from atlantis_exp.commands import CONF, DAILY, VERBS
from atlantis_exp.terminal import PROGRAM

_GROUP = re.compile(r" +- (?P<preset>override /)?(?P<group>[\w@.]+): (?P<option>\w+)\s*(?:#.*)?")
_KEY = re.compile(r"(?P<indent> *)(?P<key>\w+):(?P<value>.*?)\s*(?:#(?P<comment>.*))?")
_SHOWN = re.compile(r"  ([\w.]+)(?:=|\s|$)")  # a key in a line of help
_DAILY = ("model", "experiment", "sampler", "env", "objective", "phase")  # groups shown first
_VALUES = 30  # columns of a key and its value, before its comment

_SWEEP = """\
  -m                 a sweep over the keys that have several values, as in seed=0,1,2
"""
_FLAGS = """\
  --cfg job          print the config instead; --resolve fills in references to other keys
  --config-dir DIR   add options of your own to groups
  --help             add GROUP=OPTION for that option's keys, `all` for every key"""


def overview() -> str:
    """Return the first screen: the verbs, daily ones first."""
    lines = [f"  {name:15}{purpose}" for name, purpose in VERBS.items()]
    lines.insert(DAILY, "\nmore:")
    parts = [f"{PROGRAM} [VERB] KEY=VALUE ...", "\n".join(lines), *_plugins()]
    return "\n\n".join(
        [*parts, "No verb means train. VERB --help lists its keys; --completion bash, zsh or fish prints a script."]
    )


def help_text(verb: str, arguments: Sequence[str]) -> str:
    """Return a verb's purpose, its keys and groups, and the keys of the options that the arguments name."""
    named = dict(text.split("=", 1) for text in arguments if "=" in text)
    preset = CONF / "experiment" / f"{named.get('experiment')}.yaml"
    chosen = dict(groups_of(preset)) | named if preset.is_file() else named
    path = CONF / f"{'config' if verb == 'train' else verb}.yaml"
    refused = ("seed", "resume") if verb == "decide" else ()  # which it sets itself
    keys = [*_without(refused, _keys(path, ""))]
    own = {match[1] for line in keys if (match := _SHOWN.match(line))}
    short, full = [], []
    groups = dict(groups_of(path))
    for group, option in sorted(groups.items(), key=lambda item: (*_DAILY, item[0]).index(item[0])):
        line, *others = _of_group(group, chosen.get(group, option))
        if group in named or "all" in arguments:
            full.append("\n".join([line, *_without(own, others)]))
        elif "@" not in group:
            short.append(f"  {line}")
    parts = [f"{PROGRAM} {verb} KEY=VALUE ...\n{VERBS[verb]}"]
    parts += ["\n".join([title, *lines]) for title, lines in (("Keys:", keys), ("Groups:", short)) if lines]
    parts += sorted(full, key=lambda text: text.startswith("experiment="))  # a preset overrides the other groups
    return "\n\n".join([*parts, *_plugins(), f"Flags:\n{'' if verb in ('decide', 'search') else _SWEEP}{_FLAGS}"])


def key_names(verb: str, arguments: Sequence[str]) -> list[str]:
    """Return the groups of a verb, then every key of the options that the arguments choose."""
    path = CONF / f"{'config' if verb == 'train' else verb}.yaml"
    lines = help_text(verb, [*arguments, "all"]).partition("\nFlags:")[0].splitlines()
    return [*dict(groups_of(path)), *(match[1] for line in lines if (match := _SHOWN.match(line)))]


def options_of(group: str) -> list[str]:
    """Return the options of a group, none for any other key."""
    folder = group.partition("@")[0]
    return sorted(path.stem for path in (CONF / folder).glob("*.yaml")) if folder.isidentifier() else []


def _of_group(name: str, option: str) -> Iterator[str]:
    """Yield a group with its options, then the keys of one of them."""
    folder, _, package = name.partition("@")
    options = options_of(name)
    yield f"{name}={option}   ({', '.join(options)})"
    if not package and option in options:
        path = CONF / folder / f"{option}.yaml"
        yield from _keys(path, "" if "@package _global_" in path.read_text("utf-8") else f"{folder}.")


def _without(taken: Collection[str], lines: Iterable[str]) -> Iterator[str]:
    """Yield lines of help without those of the `taken` keys, which another file sets."""
    is_taken = False
    for line in lines:
        if match := _SHOWN.match(line):
            is_taken = match[1] in taken
        if not is_taken:
            yield line


def groups_of(path: Path) -> Iterator[tuple[str, str]]:
    """Yield the groups and options in a file's defaults list and in the files that it names."""
    for line in _defaults(path):
        if match := _GROUP.fullmatch(line):
            yield match["group"], match["option"]
        elif (other := path.parent / f"{line.strip(' -')}.yaml").is_file():
            yield from groups_of(other)


def _defaults(path: Path) -> list[str]:
    """Return the lines of a file's defaults list."""
    match = re.search(r"^defaults:\n((?: +.*\n)+)", path.read_text("utf-8"), re.MULTILINE)
    return match[1].splitlines() if match else []


def _keys(path: Path, prefix: str) -> Iterator[str]:
    """Yield a line for each key of a file: dotted key, value, comment; then those of its base files."""
    own = [*_own_keys(path, prefix)]
    yield from own
    names = {match[1] for line in own if (match := _SHOWN.match(line))}
    for line in _defaults(path):
        if (base := path.parent / f"{line.strip(' -')}.yaml").is_file():
            yield from _without(names, _keys(base, prefix))


def _own_keys(path: Path, prefix: str) -> Iterator[str]:
    """Yield a line for each key in a file itself, as `_keys`."""
    parents: list[str] = []
    in_defaults = False
    for line in path.read_text("utf-8").splitlines():
        if re.match(r" +#", line) and not in_defaults:  # a comment that continues
            yield f"  {'':{_VALUES}} {line.strip(' #')}"
        elif match := _KEY.fullmatch(line):
            depth = len(match["indent"]) // 2
            in_defaults = not depth and match["key"] == "defaults"
            parents[depth:] = [match["key"]]
            value, comment = match["value"].strip(), (match["comment"] or "").strip()
            if in_defaults or not (value or comment) or (prefix and match["key"] == "name"):
                continue
            shown = f"{prefix}{'.'.join(parents)}={value}" if value else f"{prefix}{'.'.join(parents)}"
            yield f"  {shown:{_VALUES - 1}}  {comment}".rstrip()


def _plugins() -> Iterator[str]:
    """Yield a paragraph that lists installed distributions with components; import none."""
    from atlantis_exp.components import installed

    if lines := [f"  plugins={name}: {', '.join(names)}" for name, names in installed().items()]:
        yield "\n".join(["Plugins:", *lines])
