"""Gather the pages of the site in `.site/`: docs/, README, CONTRIBUTING, CHANGELOG, lab/, and the verbs' help.

`python docs/site.py`, from the root of the checkout; then `mkdocs build` builds `site/` from them (`make docs`).
"""

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

from atlantis_exp.commands import VERBS
from atlantis_exp.commands.helping import help_text, options_of, overview

ROOT = Path(__file__).resolve().parents[1]
WHOLE = {"README": "index.md", "CONTRIBUTING": "contributing.md", "CHANGELOG": "changelog.md"}
"""Pages of the repository's root, and their names on the site."""


def main(target: Path) -> None:
    """Write all pages, pictures and tables."""
    shutil.rmtree(target, ignore_errors=True)
    (target / "lab").mkdir(parents=True)
    for folder in ("images", "data"):
        shutil.copytree(ROOT / "docs" / folder, target / folder)
    for name in ("iframe-worker.js", "json.schema.json", "site.css"):
        shutil.copy(ROOT / "docs" / name, target)
    pages = {path.name: path for path in (ROOT / "docs").glob("*.md")}
    pages |= {f"lab/{path.name}": path for path in (ROOT / "lab").glob("*.md")}
    pages |= {name: ROOT / f"{source}.md" for source, name in WHOLE.items()}
    for name, path in pages.items():
        (target / name).write_text(in_the_site(path.read_text("utf-8"), name), "utf-8")
    (target / "keys.md").write_text(keys(), "utf-8")
    (target / "verbs.md").write_text(verbs(), "utf-8")


def in_the_site(text: str, name: str) -> str:
    """Point the links of a page to the site; replace those to other parts of the repository by their text."""
    up = "../" * name.count("/")
    for source, page in WHOLE.items():
        text = re.sub(rf"\]\((?:\.\./)?{source}\.md", f"]({up}{page}", text)
    text = re.sub(r"(\]\(|src=\")(?:\.\./)?docs/", rf"\g<1>{up}", text)
    text = re.sub(r"\]\((?:\.\./)?lab/", f"]({up}lab/", text)
    elsewhere = r"(?:results|pretrained|examples|conf)(?:/[^)]*)?|SECURITY\.md"
    return re.sub(rf"\[([^\]]+)\]\((?:\.\./)*(?:{elsewhere})\)", r"\1", text)


def verbs() -> str:
    """Return the page with the help of each verb."""
    parts = [
        "# Verbs",
        "The help of every verb, as `python -m atlantis_exp VERB --help` prints it.",
        block(overview()),
    ]
    for verb in VERBS:
        parts += [f"## {verb}", block(help_text(verb, []))]
    return "\n\n".join(parts)


def block(text: str) -> str:
    """Return a text as a code block."""
    return f"```text\n{text}\n```"


def keys() -> str:
    """Return the page of a training's keys: its own, then those of each option of each group."""
    text = help_text("train", ["all"])
    groups = re.findall(r"^(\w+)=(\w+)   \(", text, re.MULTILINE)
    own = text.partition("\nKeys:\n")[2].partition("\n\n")[0]
    parts = [
        "# Keys",
        "All keys of a config with their values. `python -m atlantis_exp KEY=VALUE` sets one, `--cfg job` prints all. "
        "[Verbs](verbs.md) has the keys of the verbs.",
        table(own),
    ]
    for group, default in groups:
        parts.append(f"## {group}")
        options = options_of(group)
        parts.append(f"Options: {', '.join(f'`{option}`' for option in options)}; the default is `{default}`.")
        seen = set[str]()
        for option in [default, *(each for each in options if each != default)]:
            shown = help_text("train", [f"{group}={option}"])
            lines = shown.partition(f"\n{group}={option}   (")[2].partition("\n")[2]
            lines = re.split(r"\n\n|\n(?=\S)", lines)[0]
            if lines.strip() and lines not in seen:
                seen.add(lines)
                parts += [f"### {group}={option}", table(lines)]
    return "\n\n".join(parts)


def table(lines: str) -> str:
    """Return the lines of a help text as a table of keys, values and sentences."""
    shown = ["| key | value | |", "| --- | --- | --- |"]
    shown += [
        f"| `{key}` | {f'`{value}`' if value else ''} | {sentence.replace('|', chr(92) + '|')} |"
        for key, value, sentence in rows(lines)
    ]
    return "\n".join(shown)


def rows(lines: str) -> Iterator[tuple[str, str, str]]:
    """Yield key, value and sentence of each key of a help text; a sentence may span several lines."""
    row: list[str] = []
    for line in lines.splitlines():
        if match := re.fullmatch(r"  ([\w.]+)(?:=(.*?))?(?:  +(.*))?", line):
            if row:
                yield row[0], row[1], row[2]
            row = [match[1], match[2] or "", match[3] or ""]
        elif row:
            row[2] += f" {line.strip()}"
    if row:
        yield row[0], row[1], row[2]


if __name__ == "__main__":
    main(ROOT / ".site")
