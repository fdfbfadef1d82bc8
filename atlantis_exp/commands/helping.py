"""Print `--help`: the verbs, or a verb's keys with their comments in conf/; load nothing heavy."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from atlantis_exp.commands import CONF, DAILY, VERBS
from atlantis_exp.terminal import PROGRAM

_GROUP = re.compile(r" +- (?P<preset>override /)?(?P<group>[\w@.]+): (?P<option>\w+)\s*(?:#.*)?")
_KEY = re.compile(r"(?P<indent> *)(?P<key>\w+):(?P<value>.*?)\s*(?:#(?P<comment>.*))?")
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
    keys, groups = _help(verb, arguments)
    named = {text.split("=", 1)[0] for text in arguments if "=" in text}
    short, full = [], []
    for group, (option, own) in groups.items():
        line = f"{group}={option}   ({', '.join(options_of(group))})"
        if group in named or "all" in arguments:
            full.append("\n".join([line, *own.values()]))
        elif "@" not in group:
            short.append(f"  {line}")
    parts = [f"{PROGRAM} {verb} KEY=VALUE ...\n{VERBS[verb]}"]
    parts += ["\n".join([title, *lines]) for title, lines in (("Keys:", keys.values()), ("Groups:", short)) if lines]
    parts += sorted(full, key=lambda text: text.startswith("experiment="))  # a preset overrides the other groups
    return "\n\n".join([*parts, *_plugins(), f"Flags:\n{'' if verb in ('decide', 'search') else _SWEEP}{_FLAGS}"])


def key_names(verb: str, arguments: Sequence[str]) -> list[str]:
    """Return the groups of a verb, then every key of the options that the arguments choose."""
    keys, groups = _help(verb, arguments)
    return [*groups, *keys, *(key for _, own in groups.values() for key in own)]


def options_of(group: str) -> list[str]:
    """Return the options of a group, none for any other key."""
    folder = group.partition("@")[0]
    return sorted(path.stem for path in (CONF / folder).glob("*.yaml")) if folder.isidentifier() else []


def _help(verb: str, arguments: Sequence[str]) -> tuple[dict[str, str], dict[str, tuple[str, dict[str, str]]]]:
    """Return a verb's keys with their lines of help, and each group's chosen option with the further keys of that."""
    named = dict(text.split("=", 1) for text in arguments if "=" in text)
    preset = CONF / "experiment" / f"{named.get('experiment')}.yaml"
    chosen = dict(groups_of(preset)) | named if preset.is_file() else named
    path = CONF / f"{'config' if verb == 'train' else verb}.yaml"
    keys, groups = _keys(path, ""), {}
    if verb == "decide":
        del keys["seed"], keys["resume"]  # which it sets itself
    for group, option in sorted(dict(groups_of(path)).items(), key=lambda item: (*_DAILY, item[0]).index(item[0])):
        option, own = chosen.get(group, option), {}
        if "@" not in group and option in options_of(group):
            file = CONF / group / f"{option}.yaml"
            own = _keys(file, "" if "@package _global_" in file.read_text("utf-8") else f"{group}.")
        groups[group] = option, {key: line for key, line in own.items() if key not in keys}
    return keys, groups


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


def _keys(path: Path, prefix: str) -> dict[str, str]:
    """Return the keys of a file, then those of its base files, each with its line: dotted key, value, comment."""
    lines: dict[str, str] = {}
    parents, key = list[str](), ""
    for line in path.read_text("utf-8").splitlines():
        if re.match(r" +#", line) and key in lines:  # a comment that continues
            lines[key] += f"\n  {'':{_VALUES}} {line.strip(' #')}"
        elif match := _KEY.fullmatch(line):
            parents[len(match["indent"]) // 2 :] = [match["key"]]
            key, value = f"{prefix}{'.'.join(parents)}", match["value"].strip()
            comment = (match["comment"] or "").strip()
            if parents[0] != "defaults" and (value or comment) and not (prefix and match["key"] == "name"):
                lines[key] = f"  {f'{key}={value}' if value else key:{_VALUES - 1}}  {comment}".rstrip()
    for line in _defaults(path):
        if (base := path.parent / f"{line.strip(' -')}.yaml").is_file():
            for key, line in _keys(base, prefix).items():
                lines.setdefault(key, line)
    return lines


def _plugins() -> Iterator[str]:
    """Yield a paragraph that lists installed distributions with components; import none."""
    from atlantis_exp.components import installed

    if lines := [f"  plugins={name}: {', '.join(names)}" for name, names in installed().items()]:
        yield "\n".join(["Plugins:", *lines])
