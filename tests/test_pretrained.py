"""The weights that come with the repository: each folder is what its card says."""

from pathlib import Path

import numpy as np
import pytest

from atlantis_exp import build
from atlantis_exp.sessions.cards import build_exported_actor, metadata, read_card
from atlantis_exp.training.actor import EpsilonGreedy

REPOSITORY = Path(__file__).resolve().parents[1]
FOLDERS = sorted(path.parent for path in REPOSITORY.glob("pretrained/*/card.json"))


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_a_folder_is_what_its_card_says(folder: Path) -> None:
    card, weights = read_card(folder)  # which checks the schema and the checksum
    page = (folder / "README.md").read_text()
    assert page.startswith(metadata(folder.name, card))
    assert card.sha256 in page
    assert f"evaluate weights=pretrained/{folder.name} " in page
    actor = build_exported_actor(card.config, weights, "cpu")
    assert isinstance(actor, EpsilonGreedy)
    env = card.config.env
    values = actor.q_values(np.zeros((2, *env.state_shape), np.uint8))
    assert values.shape == (2, 4)
    assert np.isfinite(values).all()


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_the_page_of_results_has_what_a_folder_scores(folder: Path) -> None:
    card, _ = read_card(folder)
    cells = f"`{card.config.model.name}` | {np.mean(card.scores):,.0f} | {len(card.scores)}"
    assert f"| `pretrained/{folder.name}` | {cells} |" in (REPOSITORY / "docs" / "results.md").read_text()


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_a_folder_plays_alike_on_any_number_of_cores(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bit for bit: between two actions of nearly the same worth a rounding decides, and then the game is another."""
    card, weights = read_card(folder)
    env = card.config.env
    states = np.random.default_rng(0).integers(0, 256, (40, *env.state_shape), np.uint8)
    values = []
    for cores in (1, 3):
        monkeypatch.setattr(build, "OWN_THREADS", cores)
        actor = build_exported_actor(card.config, weights, "cpu")
        assert isinstance(actor, EpsilonGreedy)
        values.append(actor.q_values(states))
    np.testing.assert_array_equal(values[0], values[1])
