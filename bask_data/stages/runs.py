"""Logs of a training and its speed: outside the artifact, because they depend on the machine."""

from __future__ import annotations

import platform
import shutil
import statistics
import time
from pathlib import Path

from bask_data.artifact import write_json_atomically
from bask_data.progress import note

SPEED = ("images_per_second", "share_waited", "gpu_memory_bytes")


class RunLog:
    """TensorBoard files of a training, and `run.json` with its speed and its hardware.

    Args:
        step: at which it starts or resumes; what was logged of later steps before an interruption is ignored.
        n_steps: total number of steps.
    """

    def __init__(self, folder: Path, step: int, n_steps: int) -> None:
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.proto.event_pb2 import Event, SessionLog

        if step == 0:
            shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._n_steps = folder, n_steps
        # SummaryWriter passes events to a thread, and a kill would lose those not yet written, flushed or not.
        self._writer = EventsWriter(str(folder / "events"), filename_suffix=f".{step}")
        start = SessionLog(status=SessionLog.START)
        self._writer.write_event(Event(step=step + 1, wall_time=time.time(), session_log=start))
        self._speed: dict[str, list[float]] = {}

    def __call__(self, step: int, values: dict[str, float]) -> None:
        """Log the values of a step."""
        from tensorboardX.proto.event_pb2 import Event
        from tensorboardX.summary import scalar

        for name, value in values.items():
            summary = scalar(_tag(name), value)
            self._writer.write_event(Event(step=step, wall_time=time.time(), summary=summary))
            if name in SPEED:
                self._speed.setdefault(name, []).append(value)
        validated = {name: value for name, value in values.items() if name.startswith("validation_")}
        if validated:
            self._writer.flush()
            shown = {"loss": values["loss"], **validated}
            note(f"step {step}/{self._n_steps}: " + ", ".join(f"{name} {value:.3g}" for name, value in shown.items()))

    def close(self, device: str, n_processes: int) -> None:
        """Write the speed since it was started or resumed."""
        self._writer.close()
        median = {name: statistics.median(values) for name, values in self._speed.items()}
        machine = {"device": _device(device), "processes": n_processes}
        write_json_atomically(self._folder / "run.json", machine | median)


def _tag(name: str) -> str:
    """The name in TensorBoard, which groups by the part before the slash."""
    if name.startswith("validation_"):
        return "validation/" + name.removeprefix("validation_")
    return f"speed/{name}" if name in SPEED else f"train/{name}"


def _device(device: str) -> str:
    import torch

    return torch.cuda.get_device_name() if device.startswith("cuda") else platform.processor() or platform.machine()
