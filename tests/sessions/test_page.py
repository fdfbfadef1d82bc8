"""The life cycle of a page: what its folder says while its command works, and however that ends."""

import signal
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path

import pytest

from atlantis_exp.config import Config
from atlantis_exp.faults import Fault
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.runs.journal import Journal, Metrics, Status, Tags
from atlantis_exp.sessions.page import opened, terminable

Page = Callable[..., AbstractContextManager[Journal]]


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return RunFolder(tmp_path / "sweeps" / "sweep-1")


@pytest.fixture
def page(tiny: Callable[..., Config], folder: RunFolder, tmp_path: Path) -> Page:
    return partial(opened, folder, tiny().tracking, tmp_path, {"mlflow.runName": "mine"}, "sweep --again")


def test_a_page_is_held_and_running_until_it_is_finished_with_all_that_was_said(folder: RunFolder, page: Page) -> None:
    with page() as journal:
        assert folder.is_held
        assert (folder.status, folder.title) == ("RUNNING", "mine")
        journal.metrics({"x": 1.0}, 0)
    assert not folder.is_held
    assert (folder.status, folder.error) == ("FINISHED", "")
    with page() as journal:  # goes on behind what it said
        journal.metrics({"x": 2.0}, 1)
    records = list(folder.records())
    assert [record.step for record in records if isinstance(record, Metrics)] == [0, 1]
    assert [record.values["command"] for record in records if isinstance(record, Tags)] == ["sweep --again"] * 2


@pytest.mark.parametrize(
    ("error", "status", "reason"),
    [
        (ValueError("no room"), "FAILED", "no room"),
        (KeyError(), "FAILED", "KeyError"),
        (Fault("refused"), "FAILED", "refused"),
        (Fault("the time is over", exit_code=124), "KILLED", "the time is over"),
        (SystemExit(143), "KILLED", ""),
        (KeyboardInterrupt(), "KILLED", ""),
    ],
    ids=lambda each: repr(each),
)
def test_what_ends_a_page_early_is_its_last_status(
    folder: RunFolder, page: Page, error: BaseException, status: str, reason: str
) -> None:
    with pytest.raises(type(error)), page():
        raise error
    assert (folder.status, folder.error) == (status, reason)


def test_what_a_disk_refuses_hides_no_error(folder: RunFolder, page: Page) -> None:
    def fail() -> None:
        with page():
            (folder.path / "commit.json").unlink()
            (folder.path / "commit.json").mkdir()  # as good as a full disk
            raise ValueError("the reason")

    with pytest.raises(ValueError, match="the reason"):
        fail()


@pytest.mark.usefixtures("impatient")
def test_a_page_that_another_process_holds_is_refused_before_anything_is_prepared(
    folder: RunFolder, page: Page
) -> None:
    held = []
    with page(prepare=lambda: held.append(folder.is_held)):
        with pytest.raises(Fault, match="is held by process") as refused, page(prepare=lambda: held.append(False)):
            pass
        assert refused.value.exit_code == 75
    assert held == [True]


def test_a_page_may_judge_its_end_by_itself(folder: RunFolder, page: Page) -> None:
    def judged(error: BaseException | None) -> tuple[Status, str]:
        return "KILLED", repr(error)

    with page(ending=judged):
        pass
    assert (folder.status, folder.error) == ("KILLED", "None")
    with pytest.raises(ValueError, match="x"), page(ending=judged):
        raise ValueError("x")
    assert folder.error == "ValueError('x')"


def test_sigterm_ends_a_block_as_an_exception_does_and_is_as_before_behind_it() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit, match="143"), terminable():
        signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) is before
