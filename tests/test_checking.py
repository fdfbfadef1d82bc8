"""What a mistake is answered with, and what tells two mappings apart."""

from typing import Annotated

import pytest
from pydantic import Field
from pydantic.dataclasses import dataclass

from atlantis_exp.checking import digest, nearest, parse
from atlantis_exp.faults import ConfigError


def test_the_nearest_choice_is_named_and_few_choices_are_listed() -> None:
    assert nearest("resnt", ["cnn", "resnet"]) == "did you mean 'resnet'? (valid: cnn, resnet)"
    assert nearest("zzz", ["cnn", "resnet"]) == "no valid choice is near (valid: cnn, resnet)"
    assert nearest("zzz", []) == "no valid choice is near"
    assert nearest("key7", [f"key{number}" for number in range(13)]) == "did you mean 'key7'?"


def test_a_digest_depends_on_values_and_not_on_order() -> None:
    assert digest({"a": 1, "b": {"c": 2}}) == digest({"b": {"c": 2}, "a": 1}) != digest({"a": 1, "b": {"c": 3}})


@dataclass
class Bounded:
    error: Annotated[float, Field(ge=1e-6, lt=0.5)]


@pytest.mark.parametrize(
    ("value", "line"),
    [
        (0.0, "error=0.0: should be greater than or equal to 1e-06"),
        (0.5, "error=0.5: should be less than 0.5"),
        ("???", "error: missing; it has no default"),
    ],
)
def test_a_bound_is_written_as_a_person_writes_it(value: float | str, line: str) -> None:
    with pytest.raises(ConfigError) as refused:
        parse(Bounded, {"error": value})
    assert str(refused.value) == line
