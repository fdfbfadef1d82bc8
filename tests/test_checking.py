"""What a mistake is answered with, and what tells two mappings apart."""

from atlantis_exp.checking import digest, nearest


def test_the_nearest_choice_is_named_and_few_choices_are_listed() -> None:
    assert nearest("resnt", ["cnn", "resnet"]) == "did you mean 'resnet'? (valid: cnn, resnet)"
    assert nearest("zzz", ["cnn", "resnet"]) == "no valid choice is near (valid: cnn, resnet)"
    assert nearest("key7", [f"key{number}" for number in range(13)]) == "did you mean 'key7'?"


def test_a_digest_depends_on_values_and_not_on_order() -> None:
    assert digest({"a": 1, "b": {"c": 2}}) == digest({"b": {"c": 2}, "a": 1}) != digest({"a": 1, "b": {"c": 3}})
