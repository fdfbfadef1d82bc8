"""Complete verbs, groups, options, keys and run names for a shell, without loading anything heavy."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from atlantis_exp.checking import nearest
from atlantis_exp.commands import VERBS, default_outputs
from atlantis_exp.commands.helping import key_names, options_of
from atlantis_exp.faults import ConfigError

SCRIPTS = {
    "bash": """\
_atlantis_exp() {
    local line=${COMP_LINE:0:COMP_POINT} IFS=$' \\t\\n'
    local words=($line)
    [[ $line == *[[:space:]] ]] && words+=("")
    local word=${words[-1]}
    IFS=$'\\n'
    COMPREPLY=($(atlantis-exp --complete "${words[@]:1}"))
    [[ $word == *=* ]] && COMPREPLY=("${COMPREPLY[@]#"${word%%=*}="}")  # to bash the value is a separate word
    compopt -o nospace
}
complete -F _atlantis_exp atlantis-exp""",
    "zsh": """\
_atlantis_exp() {
    local -a found
    found=(${(f)"$(atlantis-exp --complete "${(@)words[2,CURRENT]}")"})
    compadd -S '' -- $found
}
compdef _atlantis_exp atlantis-exp""",
    "fish": "complete -c atlantis-exp -f -a '(atlantis-exp --complete (commandline -opc)[2..] (commandline -ct))'",
}
"""The scripts that shells evaluate: `eval "$(atlantis-exp --completion bash)"`."""


def complete(flag: str, words: Sequence[str]) -> str:
    """Return the completions for `--complete WORDS`, or the script for `--completion SHELL`. Raises: ConfigError."""
    if flag == "--complete":
        return "\n".join(candidates(words))
    if (shell := "".join(words)) not in SCRIPTS:
        raise ConfigError(f"--completion={shell}: no such shell; {nearest(shell, SCRIPTS)}")
    return SCRIPTS[shell]


def candidates(words: Sequence[str]) -> list[str]:
    """Return the completions of a command line's last word."""
    *before, word = words or [""]
    verb = before[0] if before and before[0] in VERBS else "train"
    key, equals, value = word.partition("=")
    if not equals:
        names = [*(VERBS if not before else ()), *(f"{name}=" for name in key_names(verb, before))]
        return [name for name in dict.fromkeys(names) if name.startswith(word)]
    first, comma, last = value.rpartition(",")
    return [f"{key}={first}{comma}{each}" for each in _values(verb, key, before) if each.startswith(last)]


def _values(verb: str, key: str, before: Sequence[str]) -> Iterator[str]:
    yield from options_of(key)
    if (key == "run" and verb in ("evaluate", "export")) or (key == "runs" and verb in ("compare", "report")):
        typed = [text.partition("=")[2] for text in before if text.startswith("paths.outputs=")]
        with suppress(RuntimeError):  # from a home folder that does not exist
            folder = Path(typed[-1]).expanduser() if typed else default_outputs()
            names = sorted(path.name for path in (folder / "runs").glob("*/"))
            yield from (name for name in names if name.isprintable())
