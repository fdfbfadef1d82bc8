"""What may be asked of `sync`."""

import pytest

from atlantis_exp.commands.overrides import check
from atlantis_exp.commands.sync import SyncConfig
from atlantis_exp.faults import ConfigError


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("to=sqlite:///x.db", "to: should be null or a server's address"),
        ("to=http://me:secret@127.0.0.1", "to: should be null or a server's address"),
        ("every=soon", "every=soon: not a duration"),
        ("every=99999999999999h", "every=99999999999999h: should be at most 10 years"),
        ("tracking=none", "tracking=none: has no store"),
        ("form=http://127.0.0.1:5000", "form=http://127.0.0.1:5000: no such key"),
    ],
)
def test_a_mistake_is_one_line_that_names_the_key(override: str, said: str) -> None:
    with pytest.raises(ConfigError) as refused:
        check("sync", SyncConfig, [override])
    assert str(refused.value).startswith(said)
    assert "secret" not in str(refused.value)


def server_of() -> str | None:
    (config,) = check("sync", SyncConfig, ["tracking=server"]).values()
    return config.tracking.uri


def test_the_team_server_is_named_by_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    def server() -> str | None:
        (config,) = check("sync", SyncConfig, ["tracking=server"]).values()
        return config.tracking.uri

    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    assert server_of() == "http://127.0.0.1:5000"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://127.0.0.1:5999")
    assert server_of() == "http://127.0.0.1:5999"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://me:secret@127.0.0.1:5999")
    with pytest.raises(ConfigError, match=r"^tracking.uri: .*MLFLOW_TRACKING_PASSWORD"):
        server()
