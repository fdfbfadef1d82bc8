"""Save the state of a whole training so that a crash at any moment leaves a whole checkpoint."""

import errno
import hashlib
import json
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import numpy as np
import safetensors.numpy
import safetensors.torch
import torch
from safetensors import SafetensorError

from atlantis_exp.faults import Fault
from atlantis_exp.replay.memory import ReplayMemory
from atlantis_exp.runs.files import CHECKPOINT, SMALL, inside, read_file, read_object, write_file

FORMAT = 1
_SEGMENTS = 64  # of a full memory, about
_DAMAGED = (OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RuntimeError, SafetensorError)
"""Errors of reading a damaged state."""
_FOR_GOOD = {errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ELOOP, errno.ENXIO, errno.EIO}
"""Errors of a lost file; others may pass, as those of a file server."""


class CheckpointError(Fault):
    """No checkpoint of a training can be used."""


@contextmanager
def unforged(folder: Path) -> Iterator[None]:
    """Raise CheckpointError if the block, which loads a state, finds damage."""
    try:
        yield
    except Fault:
        raise
    except (*_DAMAGED, MemoryError) as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise CheckpointError(f"the checkpoint in {folder} does not fit this training ({reason})") from None


def to_safetensors(tensors: Mapping[str, torch.Tensor]) -> bytes:
    """Return tensors as safetensors, which refuses shared memory: write tied weights twice."""
    written: dict[str, torch.Tensor] = {}
    places: set[int] = set()
    for name, tensor in tensors.items():
        place = tensor.untyped_storage().data_ptr()
        written[name] = (tensor.detach().clone() if place in places else tensor.detach()).contiguous()
        places.add(place)
    return safetensors.torch.save(written)


class Checkpoints:
    """The two newest generations of a training's state in a folder.

    A generation is a folder with `state.json` (the tree, with a place for each array), `tensors.safetensors` and
    `arrays.safetensors`. It counts once it has its `manifest.json`, with the checksums of all files and its own.
    Generations share the segments of the replay memory, which never change: a save adds the new observations, and
    rewrites a small last segment. `identity` names the experiment.
    """

    def __init__(self, folder: Path, identity: str) -> None:
        self.folder = folder
        self.identity = identity
        self._segments: list[dict[str, Any]] = []  # of the memory, oldest first: name, since, next_id, sha256
        self._generation = 0
        self.lost = 0  # at most so many observations are missing from the loaded memory

    def save(self, state: Mapping[str, Any], memory: ReplayMemory) -> None:
        """Write a generation. Raises: OSError, with earlier generations intact."""
        segments = [entry for entry in self._segments if entry["next_id"] > memory.oldest_id]
        since = segments[-1]["next_id"] if segments else memory.oldest_id
        if memory.next_id > since:
            if segments and since - segments[-1]["since"] < memory.capacity // _SEGMENTS:
                since = segments.pop()["since"]  # rewrite it: frequent saves would make tiny segments
            name = f"segments/{since:012d}-{memory.next_id:012d}"
            checksums = self._write(name, memory.segment(since))
            segments.append({"name": name, "since": since, "next_id": memory.next_id, "sha256": checksums})
        generation = self._generation + 1
        shutil.rmtree(self.folder / _name(generation), ignore_errors=True)  # left by a crash, without a manifest
        manifest = {
            "format": FORMAT,
            "identity": self.identity,
            "segments": segments,
            "state": self._write(_name(generation), state),
        }
        manifest["sha256"] = _checksum(manifest)
        write_file(self.folder / _name(generation) / "manifest.json", json.dumps(manifest).encode())
        self._clean(generation, {entry["name"] for entry in self._segments + segments})
        self._segments, self._generation = segments, generation

    def load(
        self, memory: ReplayMemory | None = None, warn: Callable[[str], None] = lambda _: None
    ) -> dict[str, Any] | None:
        """Return the newest whole generation's state, or None; restore `memory` if given.

        Skips damaged generations with a `warn`ing. If none has its whole memory, returns the newest one with the
        observations after its last damaged segment, and counts the others in `lost`.

        Raises:
            CheckpointError: all generations are damaged, the newest is of another experiment or a newer format, or a
                file is temporarily unreadable. The files stay unchanged.
        """
        faults: list[str] = []
        state = self._load(memory, False, faults)
        for fault in faults:
            warn(fault)
        if state is not None or not faults:
            return state
        if memory is not None and (state := self._load(memory, True, [])) is not None:
            warn(f"no checkpoint has its whole replay memory: {self.lost:,} observations are lost, the run continues")
            return state
        raise CheckpointError(f"{faults[0]}, and no older one is whole; resume=never keeps this run and starts over")

    def _load(self, memory: ReplayMemory | None, may_lose: bool, faults: list[str]) -> dict[str, Any] | None:
        """Return the newest readable state; append the faults of others."""
        for generation in sorted(self._generations(), reverse=True):
            try:
                manifest = read_object(self._content(f"{_name(generation)}/manifest.json", SMALL))
                if manifest.pop("sha256") != _checksum(manifest):
                    raise ValueError("its manifest does not have its checksum")
                self._refuse_foreign(manifest, generation)
                state = self._read(_name(generation), manifest["state"])
                segments = [_segment(entry) for entry in manifest["segments"]]
                if memory is not None and not may_lose:
                    memory.load_segments(self._read(entry["name"], entry["sha256"]) for entry in segments)
                elif memory is not None:
                    segments = self._load_what_is_left(memory, segments)
                if memory is not None and segments and segments[-1]["next_id"] != memory.next_id:
                    raise ValueError("its manifest and its replay memory end at different observations")
            except CheckpointError:
                raise
            except MemoryError:
                raise self._not_now("not enough memory") from None
            except _DAMAGED as error:
                faults.append(f"checkpoint {generation} in {self.folder} is damaged ({error})")
                continue
            self._segments, self._generation = segments, generation
            return state
        return None

    def _load_what_is_left(self, memory: ReplayMemory, segments: list[dict[str, Any]]) -> list[dict[str, Any]]:
        """Restore and return the segments after the last damaged one."""
        whole: list[dict[str, Any]] = []
        contents: list[dict[str, Any]] = []
        try:
            for entry in reversed(segments):
                contents.insert(0, self._read(entry["name"], entry["sha256"]))
                whole.insert(0, entry)
        except _DAMAGED as error:
            if isinstance(error, CheckpointError):  # a RuntimeError, too
                raise
        oldest_id, next_id = int(segments[0]["since"]), int(segments[-1]["next_id"])
        memory.load_segments(contents, next_id)
        self.lost = memory.oldest_id - max(oldest_id, next_id - memory.capacity)
        return whole

    def _refuse_foreign(self, manifest: Mapping[str, Any], generation: int) -> None:
        if manifest["format"] > FORMAT:
            raise CheckpointError(
                f"checkpoint {generation} in {self.folder} has format {manifest['format']}, "
                f"this version reads up to {FORMAT}: upgrade atlantis_exp"
            )
        if manifest["identity"] != self.identity:
            raise CheckpointError(
                f"checkpoint {generation} in {self.folder} belongs to experiment {manifest['identity']}, "
                f"not to {self.identity}"
            )

    def _generations(self) -> list[int]:
        folders = self.folder.glob("[0-9]*/manifest.json")
        return [int(path.parent.name) for path in folders if path.parent.name.isdecimal()]

    def _write(self, name: str, tree: Mapping[str, Any]) -> dict[str, str]:
        """Write a state tree to files of a new folder; return their checksums."""
        files = files_of(tree)
        for file, content in files.items():
            write_file(self.folder / name / file, content)
        return {file: hashlib.sha256(content).hexdigest() for file, content in files.items()}

    def _read(self, name: str, checksums: Mapping[str, str]) -> dict[str, Any]:
        contents = {file: self._content(f"{name}/{file}", CHECKPOINT) for file in checksums}
        for file, content in contents.items():
            if hashlib.sha256(content).hexdigest() != checksums[file]:
                raise ValueError(f"{name}/{file} does not have its checksum")
        tensors = safetensors.torch.load(contents["tensors.safetensors"]) if "tensors.safetensors" in contents else {}
        arrays = safetensors.numpy.load(contents["arrays.safetensors"]) if "arrays.safetensors" in contents else {}
        return cast(dict[str, Any], _assemble(read_object(contents["state.json"]), tensors, arrays))

    def _content(self, name: str, most: int) -> bytes:
        """Return a file's bytes. Raises: CheckpointError if it may be whole; OSError, ValueError if it is not."""
        try:
            return read_file(inside(self.folder, name), most)
        except OSError as error:
            if error.errno in _FOR_GOOD:
                raise
            raise self._not_now(str(error)) from error

    def _not_now(self, reason: str) -> CheckpointError:
        return CheckpointError(
            f"the checkpoints in {self.folder} cannot be read now ({reason}), but may be whole; repeat the command, or "
            f"add resume=never, which keeps this run and starts over"
        )

    def _clean(self, generation: int, segments: set[str]) -> None:
        """Remove all but this generation, the previous one, and their segments."""
        for older in self._generations():
            if older < generation - 1:
                shutil.rmtree(self.folder / _name(older), ignore_errors=True)
        for path in self.folder.glob("segments/*"):
            if f"segments/{path.name}" not in segments:
                shutil.rmtree(path, ignore_errors=True)


def files_of(tree: Mapping[str, Any]) -> dict[str, bytes]:
    """Return the files that hold a state tree, by name."""
    tensors: dict[str, torch.Tensor] = {}
    arrays: dict[str, np.ndarray[Any, Any]] = {}
    files = {"state.json": json.dumps(_disassemble(tree, "", tensors, arrays)).encode()}
    if tensors:
        files["tensors.safetensors"] = to_safetensors(tensors)
    if arrays:
        files["arrays.safetensors"] = safetensors.numpy.save(arrays)
    return files


def _checksum(manifest: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()


def _segment(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return a segment's entry in a manifest. Raises: KeyError, TypeError, ValueError."""
    since, next_id = int(entry["since"]), int(entry["next_id"])
    return {"name": str(entry["name"]), "since": since, "next_id": next_id, "sha256": dict(entry["sha256"])}


def _name(generation: int) -> str:
    return f"{generation:08d}"


def _disassemble(
    node: Any, path: str, tensors: dict[str, torch.Tensor], arrays: dict[str, np.ndarray[Any, Any]]
) -> Any:
    """Return the tree without its tensors and arrays, which move to the tables under their paths."""
    if isinstance(node, torch.Tensor):
        tensors[path] = node
        return {"$tensor": path}
    if isinstance(node, np.ndarray):
        arrays[path] = np.ascontiguousarray(node)
        return {"$array": path, "shape": list(node.shape)}
    if isinstance(node, Mapping):
        prefix = f"{path}." if path else ""
        return {key: _disassemble(value, f"{prefix}{key}", tensors, arrays) for key, value in node.items()}
    return node


def _assemble(node: Any, tensors: Mapping[str, torch.Tensor], arrays: Mapping[str, np.ndarray[Any, Any]]) -> Any:
    if not isinstance(node, dict):
        return node
    if "$tensor" in node:
        return tensors[node["$tensor"]]
    if "$array" in node:
        return arrays[node["$array"]].reshape(node["shape"])  # ascontiguousarray made vectors of scalars
    return {key: _assemble(value, tensors, arrays) for key, value in node.items()}
