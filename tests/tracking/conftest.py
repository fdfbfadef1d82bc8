from pathlib import Path

import pytest

from atlantis_exp.tracking.store import Store


@pytest.fixture(scope="session")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("store")


@pytest.fixture(scope="session")
def store(root: Path) -> Store:
    return Store(root)
