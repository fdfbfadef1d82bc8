"""Put a family's answer and the state of its looks into sentences."""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from atlantis_exp.comparison.decision import Plan, Verdict
from atlantis_exp.comparison.verdict import Answer, Question

IN_FULL = 3  # most pairs of a family that are named with their intervals
_LISTED = 6  # most undecided pairs that are named
_NAMED = 3  # names out of many


def measure(question: Question) -> str:
    """Return the definition of a seed's score."""
    match question.score:
        case "last":
            return "the interquartile mean (IQM) of the seed's evaluated episodes after its last step"
        case "training":
            return (
                f"the seed's points in the last {100 * question.window:g}% of its training over the episodes that "
                "ended there: with the training's epsilon and latest weights, so it measures the process of learning, "
                "not the network one keeps"
            )
        case _:
            return "the mean of the seed's rows in a table"


def said(answer: Answer) -> str:
    """Return the decided and undecided pairs as sentences, better groups first."""
    verdicts, plan = answer.decision.verdicts, answer.family.plan
    in_full = len(verdicts) <= IN_FULL
    better: dict[tuple[str, str], list[str]] = defaultdict(list)
    for verdict in verdicts:
        if verdict.said in ("better", "worse"):
            leading = verdict.leading
            by = f" by {points(leading.difference)} points ({_interval(leading)})" if in_full else ""
            of = verdict if plan.baseline is not None else leading
            better[of.group, of.said].append(f"{of.other}{by}")
    sentences = [f"{name} plays {how} than {' and than '.join(others)}" for (name, how), others in better.items()]
    for verdict in verdicts:
        if verdict.said == "equivalent":
            interval = f" ({_interval(verdict)})" if in_full else ""
            sentences.append(
                f"{verdict.group} is as good as {verdict.other}: no difference larger than {margin(plan)}{interval}"
            )
    if unsure := [verdict for verdict in verdicts if verdict.said == "not decided"]:
        sentences.append(_undecided(answer, unsure, in_full))
    return ". ".join(sentences) + "."


def _undecided(answer: Answer, verdicts: Sequence[Verdict], in_full: bool) -> str:
    decision = answer.decision
    if len(verdicts) > _LISTED:
        text = f"Not decided: {len(verdicts)} of {len(decision.verdicts)} pairs"
    else:
        found = (
            f" (difference {points(of.difference)}, {_interval(of)})" if in_full and of.seeds else "" for of in verdicts
        )
        pairs = (f"{of.group} against {of.other}{interval}" for of, interval in zip(verdicts, found, strict=True))
        text = f"Not decided: {', '.join(pairs)}"
    if decision.next_look is not None:
        there = {value: len(answer.family.seeds[value]) for value in decision.contenders}
        fewer = [f"{value} has {seeds}" for value, seeds in there.items() if seeds < decision.next_look]
        which = f" ({', '.join(fewer)})" if 0 < len(fewer) <= _LISTED else ""
        if len(sizes := {*there.values()}) == 1:
            which = f" (there are {min(sizes)} each)"
        return f"{text}; next look at {decision.next_look} seeds{which}"
    text += ", and this plan has no further look"
    reaches = [verdict.detectable for verdict in verdicts if verdict.detectable is not None]
    if not reaches:  # its last look was one of a longer plan
        return text
    if not any(reaches):
        return f"{text}; the detectable difference is unknown, since seeds do not differ"
    return f"{text}; a difference of {points(max(reaches))} would have been found with 80 %"


def spent(answer: Answer) -> str:
    """Return the looks planned and taken, and the error spent."""
    plan, looks = answer.family.plan, answer.decision.looks
    return (
        f"looks planned at {' and '.join(map(str, plan.looks))} seeds; "
        f"taken: {', '.join(str(look.size) for look in looks) or 'none'}; "
        f"error spent: {answer.decision.spent:.2%} of {plan.error:.2%}"
    )


def margin(plan: Plan) -> str:
    """Format the plan's delta for people; empty without one."""
    if plan.delta is None:
        return ""
    return f"{100 * plan.delta:g} %" if plan.relative else f"{points(plan.delta)} points"


def listed(names: Sequence[str]) -> str:
    """Join names, at most the first three."""
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")


def _interval(verdict: Verdict) -> str:
    return f"{points(verdict.low)} to {points(verdict.high)}, {verdict.seeds} seeds each"


def points(value: float) -> str:
    """Format a number for people."""
    return f"{value:,.0f}" if abs(value) >= 10 or value == np.round(value) else f"{value:.3g}"
