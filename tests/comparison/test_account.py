"""One account of error for runs, however a question about them is put."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import pytest

from atlantis_exp.comparison.account import Account, Asked, open_account
from atlantis_exp.comparison.decision import Look
from atlantis_exp.comparison.verdict import Answer, Family, Group, Question, answer, families

AROUND = (0.0, 30.0, -20.0, 10.0, -30.0, 20.0, 5.0, -15.0, 25.0, -5.0) * 2  # points around a group's score, one a seed
SCORES = {"a": 3_000.0, "b": 3_003.0, "c": 9_000.0, "d": 3_001.0}


class Runs:
    """Comparisons of the same runs, each put in its own words."""

    def __init__(self) -> None:
        self.asked: dict[str, Asked] = {}

    def ask(
        self,
        name: str,
        groups: Iterable[str],
        there: Sequence[int] = range(5),
        words: str = "",
        now: bool = False,
        **question: object,
    ) -> tuple[Answer, Account]:
        """Ask of seeds of some groups; `words` stand before their labels."""
        labels = {group: f"{words}{group}" for group in groups}
        found = [
            Group((label,), {seed: SCORES[group] + AROUND[seed] for seed in there}) for group, label in labels.items()
        ]
        asked = families(found, Question(["model"], **question))  # type: ignore[arg-type]
        runs = [f"{group}-s{seed}" for group in groups for seed in there]
        before = self.asked.get(name)
        mine = Asked(
            by=["model"],
            error=asked[0].plan.error,
            delta=asked[0].plan.delta,
            relative=False,
            baseline=None,
            groups=[[label, f"recipe of {group}"] for group, label in labels.items()],
            compared=sorted({*runs, *(before.compared if before else ())}),
            account=before.account if before else "",
            errors=before.errors if before else {},
            name=name,
            record=before.record if before else {},
        )
        others = [other for other in self.asked.values() if other.name != name]
        account = open_account(asked, mine, others, runs)
        (answered,) = answer(account.limit(asked), account.record, now)
        kept = {"account": account.root, "errors": dict(account.errors)} if account.errors else {}
        self.asked[name] = replace(mine, record={"model": answered.decision.looks}, **kept)  # type: ignore[arg-type]
        return answered, account


def looked_at_five_and_ten() -> Runs:
    runs = Runs()
    runs.ask("ten", "ab")
    runs.ask("ten", "ab", range(10))
    return runs


def sizes(answered: Answer) -> list[int]:
    return [look.size for look in answered.decision.looks]


def said(answered: Answer) -> dict[tuple[str, str], str]:
    return {(verdict.group, verdict.other): verdict.said for verdict in answered.decision.verdicts}


def test_a_longer_plan_goes_on_with_the_looks_and_the_error_of_the_shorter_one() -> None:
    runs = looked_at_five_and_ten()
    longer, account = runs.ask("twenty", "ab", range(20), seeds=20)
    assert sizes(longer) == [5, 10]
    assert longer.decision.spent == pytest.approx(0.05)
    assert longer.decision.next_look is None
    assert account.lines == ["By model, this continues the looks of ten; to look further, allow a larger error=."]
    dearer, _ = runs.ask("dearer", "ab", range(20), seeds=20, error=0.1)
    assert sizes(dearer) == [5, 10, 20]
    assert dearer.decision.looks[-1].error == pytest.approx(0.05)


def test_a_shorter_plan_finds_the_looks_of_the_longer_one() -> None:
    runs = looked_at_five_and_ten()
    shorter, _ = runs.ask("five", "ab", range(10), seeds=5)
    assert sizes(shorter) == [5, 10]


def test_plans_of_five_six_and_so_on_to_ten_seeds_look_once() -> None:
    runs = Runs()
    found = [runs.ask(f"{seeds}", "ab", range(seeds), seeds=seeds)[0] for seeds in range(5, 11)]
    assert [sizes(each) for each in found] == [[5]] * 6
    assert {each.decision.spent for each in found} == {0.05}


def test_other_words_for_the_same_runs_are_the_same_question() -> None:
    runs = Runs()
    first, _ = runs.ask("one", "ac", range(5))
    other, account = runs.ask("other", "ca", range(5), words="z")
    assert said(other) == {("za", "zc"): "worse"}
    assert other.decision.looks[0].error == first.decision.looks[0].error
    assert account.root == "one"
    again, account = runs.ask("one", "ac", range(5))
    assert again.decision == first.decision
    assert again.family.plan == first.family.plan
    assert account.lines == []


def test_a_question_takes_over_what_the_other_spelling_has_found_since() -> None:
    runs = Runs()
    runs.ask("one", "ab")
    runs.ask("other", "ab", range(8), now=True)
    again, account = runs.ask("one", "ab", range(10))
    assert sizes(again) == [5, 8, 10]
    assert again.decision.spent == pytest.approx(0.05)
    assert account.lines == []


def test_a_pair_of_several_groups_has_their_verdict_and_its_share_of_their_error() -> None:
    runs = Runs()
    whole, _ = runs.ask("whole", "abcd")
    pair, account = runs.ask("pair", "cb")
    assert account.lines == ["By model, this continues the looks of whole, which has 6 pairs in all."]
    (verdict,) = pair.decision.verdicts
    assert verdict == next(each for each in whole.decision.verdicts if (each.group, each.other) == ("b", "c"))
    assert pair.decision.spent == pytest.approx(0.0125 / 6)
    open_pair, _ = runs.ask("open", "ab")
    assert sizes(open_pair) == [5]
    later, _ = runs.ask("open", "ab", range(10))
    assert sizes(later) == [5, 10]
    assert later.decision.looks[-1].error == pytest.approx(0.0375 / 3)  # a, b and d are open
    whole, account = runs.ask("whole", "abcd", range(10))
    assert account.lines == []
    (there,) = (each for each in whole.decision.verdicts if (each.group, each.other) == ("a", "b"))
    (here,) = later.decision.verdicts
    assert (here.difference, here.low, here.high) == pytest.approx((there.difference, there.low, there.high))


def test_a_part_in_other_words_has_no_more_error_than_the_part() -> None:
    runs = Runs()
    runs.ask("whole", "abcd")
    runs.ask("pair", "ab", range(8), now=True)
    other, _ = runs.ask("other", "ab", range(10), words="z")
    assert sizes(other) == [5, 8, 10]
    assert other.decision.spent == pytest.approx(0.0125 / 6 + 0.0375 / 3)


def test_a_pair_that_may_be_equivalent_has_its_share_of_all_pairs() -> None:
    runs = Runs()
    runs.ask("whole", "abcd", delta=1.0)
    pair, _ = runs.ask("pair", "ab", range(10), delta=1.0)
    assert [look.error for look in pair.decision.looks] == pytest.approx([0.0125 / 6, 0.0375 / 6])


def test_the_pairs_verdict_is_turned_where_the_question_names_them_the_other_way_round() -> None:
    runs = Runs()
    runs.ask("whole", "ac")
    turned, _ = runs.ask("turned", "ca", baseline="a")
    (verdict,) = turned.decision.verdicts
    assert (verdict.group, verdict.other, verdict.said) == ("c", "a", "better")
    assert 0 < verdict.low < verdict.difference < verdict.high


def test_more_groups_than_were_asked_are_told_what_was_spent() -> None:
    runs = Runs()
    runs.ask("two", "ab")
    _, account = runs.ask("three", "abc")
    (line,) = account.lines
    assert line.startswith("1 other question about these runs spent 1.25% of error;")
    runs.ask("others", "cd")
    _, account = runs.ask("four", "abcd")
    assert account.lines[0].startswith("3 other questions about these runs spent 3.75% of error;")
    _, account = runs.ask("two", "ab")
    assert account.lines[0].startswith("2 other questions about these runs spent 2.50% of error;")


def test_another_delta_is_another_question_and_is_told() -> None:
    runs = Runs()
    runs.ask("plain", "ab")
    other, account = runs.ask("equal", "ab", delta=100.0)
    assert other.decision.spent == 0.0125
    assert account.lines[0].startswith("1 other question about these runs")


def test_other_runs_of_the_same_groups_are_another_question_and_are_told() -> None:
    runs = Runs()
    runs.ask("first", "ab")
    other, account = runs.ask("other", "ab", range(5, 10), words="z")
    assert other.decision.looks[0].seeds["za"] == [5, 6, 7, 8, 9]
    assert other.decision.spent == 0.0125
    assert [line[:31] for line in account.lines] == ["1 other question about these ru"]


def test_a_smaller_error_than_was_spent_does_not_go_on() -> None:
    runs = Runs()
    runs.ask("loose", "ab", range(10), error=0.5)
    strict, account = runs.ask("strict", "ab", range(10))
    assert strict.decision.spent == pytest.approx(0.05)
    assert account.lines[0].startswith("1 other question about these runs spent 50.00% of error;")


def test_a_question_that_looked_for_itself_keeps_its_looks() -> None:
    runs = Runs()
    own, _ = runs.ask("pair", "ab")
    runs.ask("whole", "abc")
    again, account = runs.ask("pair", "ab", range(10))
    assert again.decision.looks[0] == own.decision.looks[0]
    assert again.decision.spent == pytest.approx(0.05)
    assert account.errors == {}


def test_an_unplanned_look_at_a_part_is_told_to_the_whole() -> None:
    runs = Runs()
    runs.ask("whole", "abd")
    runs.ask("pair", "ab", range(8), now=True)
    _, account = runs.ask("whole", "abd", range(10))
    assert account.lines[0].startswith("1 other question about these runs spent ")


def test_runs_that_were_compared_before_and_are_gone_are_named() -> None:
    runs = Runs()
    runs.ask("one", "ab", range(4))
    _, account = runs.ask("one", "ab", (0, 1, 2, 4, 5))
    assert account.lines[0].startswith("Compared before, and gone or left out now: a-s3, b-s3. If their scores are")
    _, account = runs.ask("other", "ab", (0, 1, 2, 4, 6), words="z")
    assert "left out now: a-s3, a-s5, b-s3 and 1 more." in account.lines[-1]


def test_groups_of_one_recipe_are_told_apart_by_their_labels() -> None:
    asked = Asked([], 0.05, None, False, None, [["old", "recipe"], ["new", "recipe"]], [])
    assert asked.identities == {"old": ("recipe", "old"), "new": ("recipe", "new")}


def test_a_question_about_one_group_has_no_account() -> None:
    assert open_account([], Asked([], 0.05, None, False, None, [["a", "x"]], ["a-s0"]), [], ["a-s0"]).lines == ()


def test_averages_go_on_where_the_whole_question_is_the_same() -> None:
    def asked(name: str, record: dict[str, list[Look]], others: Sequence[Asked], seeds: int) -> tuple[Asked, Account]:
        groups = [
            Group((model, sampler), {seed: score + AROUND[seed] for seed in range(seeds)})
            for model, score in (("cnn", 100.0), ("resnet", 101.0))
            for sampler in ("top", "uniform")
        ]
        found: list[Family] = families(groups, Question(["model", "sampler"], seeds=seeds))
        labels = [[group.label, group.label] for group in groups]
        mine = Asked(["model", "sampler"], 0.05, None, False, None, labels, ["x"], name=name, record=record)
        account = open_account(found, mine, others, ["x"])
        answers = answer(account.limit(found), account.record)
        return replace(mine, record={each.family.name: each.decision.looks for each in answers}), account

    first, _ = asked("first", {}, [], 10)
    second, account = asked("second", {}, [first], 20)
    assert account.errors == pytest.approx(dict.fromkeys(("model", "sampler", "model,sampler"), 0.05 / 3))
    assert second.record == first.record
    assert account.root == "first"


def test_groups_of_a_table_are_those_of_the_same_table_only() -> None:
    asked = Asked(["group"], 0.05, None, False, None, ["a", "b"], [], score="file", scores="/x.csv")
    assert asked.identities == {"a": ("/x.csv", "a"), "b": ("/x.csv", "b")}
    assert asked.measure != replace(asked, score="training").measure
    assert asked.measure == replace(asked, columns={"score": "score"}).measure
    assert asked.measure != replace(asked, columns={"score": "return"}).measure
