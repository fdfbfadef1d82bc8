"""A team's server as `docs/server.sh` starts it: MLflow with accounts, on a PostgreSQL of its own."""

import os
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest

from atlantis_exp.runs.journal import Metrics, read

REPOSITORY = Path(__file__).parents[2]
PROGRAMS = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
WRITER = """
import io, sys, time
from pathlib import Path
from PIL import Image
from atlantis_exp.runs.journal import Journal
from atlantis_exp.tracking.publishing import Publisher
from atlantis_exp.tracking.store import Store
outputs, name, address = Path(sys.argv[1]), sys.argv[2], sys.argv[3]
journal = Journal(outputs / "runs" / name, {"mlflow.runName": name})
publisher = Publisher(outputs / "runs" / name, Store(outputs, tracking_uri=address), interval=0.5)
picture = io.BytesIO()
Image.new("L", (8, 8)).save(picture, "PNG")
journal.params({"seed": name})
for step in range(40 * 25):
    journal.metrics({f"score/{key}": step + key / 8 for key in range(12)}, step)
    if step % 25 == 24:
        if step % 100 == 99:
            journal.image("score/histogram", picture.getvalue(), step)
        journal.state_dict()
        journal.commit()
        time.sleep(0.5)
journal.artifact("report.txt", name.encode())
journal.model("network", name.encode(), step, {"score/0": float(step)})
journal.state_dict()
journal.commit()
journal.status("FINISHED")
sys.exit(0 if publisher.drain(120) else 1)
"""


def test_secrets_of_any_characters_are_kept_as_they_are_given(tmp_path: Path) -> None:
    python = tmp_path / "python"
    python.write_text('#!/bin/sh\nprintf "%s\\n" "$MLFLOW_AUTH_ADMIN_PASSWORD" "$MLFLOW_FLASK_SERVER_SECRET_KEY"\n')
    python.chmod(0o700)
    given = {
        "MLFLOW_AUTH_ADMIN_PASSWORD": "pa $HOME wo'r\"%d=",
        "MLFLOW_FLASK_SERVER_SECRET_KEY": "c2VjcmV0LWtleS0xMjM=",
    }

    def started(**environment: str) -> "subprocess.CompletedProcess[str]":
        own = {"PATH": os.environ["PATH"], "ATLANTIS_DATABASE": "x", "PYTHON": "./python", **environment}
        command = ["bash", str(REPOSITORY / "docs" / "server.sh"), "folder"]
        return subprocess.run(command, cwd=tmp_path, env=own, capture_output=True, text=True, check=True)

    first, again = started(**given), started(MLFLOW_AUTH_ADMIN_PASSWORD="other")
    assert first.stdout.splitlines() == again.stdout.splitlines() == [*given.values()]
    assert first.stderr == ""
    assert again.stderr == f"the password of {tmp_path / 'folder' / 'secrets'} counts\n"
    assert stat.S_IMODE((tmp_path / "folder" / "secrets").stat().st_mode) == 0o600


@pytest.fixture
def database() -> Iterator[str]:
    """The address of an empty PostgreSQL database, which wants a password."""
    pytest.importorskip("psycopg2", reason="psycopg2: extra `server`")
    pytest.importorskip("flask_wtf", reason="flask-wtf: extra `server`")
    if not PROGRAMS:
        pytest.skip("there is no PostgreSQL in /usr/lib/postgresql (Debian's package postgresql)")
    folder = Path(tempfile.mkdtemp(prefix="postgres-"))
    programs, data = PROGRAMS[-1].parent, folder / "data"
    (folder / "password").write_text("secret%2F")
    as_owner: dict[str, Any] = {"cwd": folder, "check": True, "stdout": subprocess.DEVNULL}
    if os.geteuid() == 0:  # as which it refuses to run
        as_owner["user"] = "postgres"
        for path in (folder, folder / "password"):
            shutil.chown(path, "postgres")
    options = f"-c listen_addresses='' -c unix_socket_directories={folder} -c fsync=off"
    try:
        account: tuple[str | Path, ...] = ("-U", "team", "--pwfile", folder / "password", "-A", "scram-sha-256")
        subprocess.run((programs / "initdb", "-D", data, *account), **as_owner)
        control: tuple[str | Path, ...] = (programs / "pg_ctl", "-D", data, "-w", "-l", folder / "log")
        subprocess.run((*control, "-o", options, "start"), **as_owner)
        yield f"postgresql+psycopg2://team:secret%252F@/postgres?host={folder}"
        subprocess.run((*control, "-m", "immediate", "stop"), **as_owner)
    finally:
        shutil.rmtree(folder)


@contextmanager
def serving(folder: Path, database: str, port: int, answering: Callable[..., None]) -> Iterator[int]:
    """The team's server, which ends by SIGKILL; yields its process group."""
    environment = {**os.environ, "ATLANTIS_DATABASE": database, "PYTHON": sys.executable}
    with open(folder.with_suffix(".log"), "a") as log:
        process = subprocess.Popen(
            (REPOSITORY / "docs/server.sh", folder, str(port)),
            env=environment,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
    try:
        answering(process, port)
        yield process.pid
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@pytest.mark.slow
def test_eight_runs_write_at_once_while_the_server_is_killed_and_started_again(
    tmp_path: Path,
    database: str,
    free_port: Callable[[], int],
    answering: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import psycopg2
    from mlflow.server import get_app_client

    port = free_port()
    address, outputs, server = f"http://127.0.0.1:{port}", tmp_path / "outputs", tmp_path / "server"
    names = [f"run-{number}" for number in range(8)]

    def sent() -> int:
        with closing(psycopg2.connect(database.replace("+psycopg2", ""))) as connection, connection.cursor() as cursor:
            cursor.execute("SELECT count(*) FROM metrics")
            return int(cursor.fetchone()[0])

    with serving(server, database, port, answering) as group:
        secrets = dict(line.split("=") for line in (server / "secrets").read_text().split())
        for name in ("secrets", "auth.ini"):
            assert stat.S_IMODE((server / name).stat().st_mode) == 0o600
        members = [process for process in psutil.process_iter() if os.getpgid(process.pid) == group]
        listeners = {
            link.laddr.ip for process in members for link in process.net_connections() if link.status == "LISTEN"
        }
        assert listeners == {"127.0.0.1"}
        monkeypatch.setenv("MLFLOW_TRACKING_USERNAME", "admin")
        monkeypatch.setenv("MLFLOW_TRACKING_PASSWORD", secrets["MLFLOW_AUTH_ADMIN_PASSWORD"])
        get_app_client("basic-auth", address).create_user("ada", secrets.setdefault("ada", "twelve letters"))
        monkeypatch.setenv("MLFLOW_TRACKING_USERNAME", "ada")
        monkeypatch.setenv("MLFLOW_TRACKING_PASSWORD", secrets["ada"])
        writers = [
            subprocess.Popen((sys.executable, "-c", WRITER, outputs, name, address), cwd=REPOSITORY) for name in names
        ]
        patience = time.monotonic() + 120
        while sent() < 2_000:
            assert time.monotonic() < patience
            time.sleep(0.2)
    assert all(writer.poll() is None for writer in writers)
    time.sleep(2.0)
    with serving(server, database, port, answering):
        assert [writer.wait() for writer in writers] == [0] * 8

        with closing(psycopg2.connect(database.replace("+psycopg2", ""))) as connection, connection.cursor() as cursor:
            cursor.execute("SELECT name, key, step, timestamp, value FROM metrics JOIN runs USING (run_uuid)")
            points = sorted(cursor.fetchall())
        assert points == sorted(
            (name, key, record.step, record.time, value)
            for name in names
            for _, record in read(outputs / "runs" / name)
            if isinstance(record, Metrics)
            for key, value in record.values.items()
        )
        assert len(points) == 8 * 1_000 * 12

        def command(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
            sync = (sys.executable, "-m", "atlantis_exp", "sync", f"paths.outputs={outputs}", *arguments)
            return subprocess.run(
                sync, cwd=REPOSITORY, env={**os.environ, **environment}, capture_output=True, text=True, check=False
            )

        done = command(f"to={address}")
        assert (done.returncode, done.stderr) == (0, "")
        refused = command(f"to={address}", MLFLOW_TRACKING_PASSWORD="wrong")
        assert (refused.returncode, refused.stderr.count("\n")) == (1, 1)
        assert "401" in refused.stderr
        assert all(secret not in refused.stderr for secret in secrets.values())
