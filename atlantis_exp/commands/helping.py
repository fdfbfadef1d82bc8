"""`--help` of a verb: its keys and groups with the sentences that stand next to them in conf/; loads nothing heavy."""

import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path

from atlantis_exp.commands import CONF, VERBS
from atlantis_exp.terminal import PROGRAM

_GROUP = re.compile(r" +- (?P<preset>override /)?(?P<group>[\w@.]+): (?P<option>\w+)\s*(?:#.*)?")
_KEY = re.compile(r"(?P<indent> *)(?P<key>\w+):(?P<value>.*?)\s*(?:#(?P<comment>.*))?")
_SHOWN = re.compile(r"  ([\w.]+)(?:=|\s|$)")  # a key as a help shows it
_VALUES = 30  # columns of a key and its value, behind which its sentence begins

_SWEEP = """\
  -m                 a sweep over the keys that have several values, as in seed=0,1,2
"""
_FLAGS = """\
  --cfg job          print the config instead; --resolve fills in what refers to other keys
  --config-dir DIR   further options of groups, in files of your own
  --version          of atlantis-exp
  --help"""


def help_text(verb: str, arguments: Sequence[str]) -> str:
    """What a verb does, and every key it takes; of a group those of the option that the arguments choose."""
    chosen = dict(text.split("=", 1) for text in arguments if "=" in text)
    preset = CONF / "experiment" / f"{chosen.get('experiment')}.yaml"
    if preset.is_file():
        chosen = dict(_groups(preset)) | chosen
    path = CONF / f"{'config' if verb == 'train' else verb}.yaml"
    groups = dict(_groups(path))
    parts = [f"{PROGRAM} {verb} KEY=VALUE ...\n{VERBS[verb]}"]
    if keys := [*_keys(path, "")]:
        parts.append("\n".join(["== Keys ==", *keys]))
    if groups:
        parts.append("== Groups, chosen by GROUP=OPTION, and the keys of the option that is chosen ==")
    own = {match[1] for line in keys if (match := _SHOWN.match(line))}
    for group, option in groups.items():
        parts.append("\n".join(_without(own, _of_group(group, chosen.get(group, option)))))
    if plugins := _plugins():
        parts.append("\n".join(["== Plugins ==", *plugins]))
    parts.append(f"== Flags ==\n{'' if verb in ('decide', 'search') else _SWEEP}{_FLAGS}")
    parts.append("\n".join(["== Verbs ==", *(f"  {name:15}{purpose}" for name, purpose in VERBS.items())]))
    return "\n\n".join(parts)


def _of_group(name: str, option: str) -> Iterator[str]:
    folder, _, package = name.partition("@")
    options = sorted(path.stem for path in (CONF / folder).glob("*.yaml"))
    yield f"{name}={option}   ({', '.join(options)})"
    path = CONF / folder / f"{option}.yaml"
    if not package and path.is_file():
        yield from _keys(path, "" if "@package _global_" in path.read_text("utf-8") else f"{folder}.")


def _without(taken: Collection[str], lines: Iterable[str]) -> Iterator[str]:
    """The lines of a group but for keys that the verb's own file sets, with their sentences."""
    is_taken = False
    for line in lines:
        if match := _SHOWN.match(line):
            is_taken = match[1] in taken
        if not is_taken:
            yield line


def _groups(path: Path) -> Iterator[tuple[str, str]]:
    """The groups of a file's defaults list and their options, those of the files that it names included."""
    for line in _defaults(path):
        if match := _GROUP.fullmatch(line):
            yield match["group"], match["option"]
        elif (other := path.parent / f"{line.strip(' -')}.yaml").is_file() and other.stem != "hydra_defaults":
            yield from _groups(other)


def _defaults(path: Path) -> list[str]:
    """The lines of a file's defaults list."""
    match = re.search(r"^defaults:\n((?: +.*\n)+)", path.read_text("utf-8"), re.MULTILINE)
    return match[1].splitlines() if match else []


def _keys(path: Path, prefix: str) -> Iterator[str]:
    """A line a key of a file, those of the files that it is made of first: dotted key, value, sentence."""
    for line in _defaults(path):
        if (base := path.parent / f"{line.strip(' -')}.yaml").is_file() and base.stem != "hydra_defaults":
            yield from _keys(base, prefix)
    parents: list[str] = []
    in_defaults = False
    for line in path.read_text("utf-8").splitlines():
        if re.match(r" +#", line) and not in_defaults:  # a sentence that goes on
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


def _plugins() -> list[str]:
    """Return a line for each installed distribution with components; imports none of them."""
    from atlantis_exp.components import installed

    return [f"  plugins={name}: {', '.join(names)}" for name, names in installed().items()]
