"""Runs a real neural network at a set number of threads and frames per second: the load that pushes a task away.

Knows: where a network comes from without internet, how fast to run it, when to stop. Does not know: which node it
loads, or why; its starter puts the process into that node's cgroup.

The network is the text detector (real weights) whose file lies inside the ``rapidocr`` wheel; the file is located
without importing that package. Next best is the ResNet-50 graph of the ``onnx`` wheel (constants for weights, the same
arithmetic), and at last a convolution loop in numpy, which is labelled synthetic. Every second one line of JSON goes to
stdout: ``{"t_s", "frames", "fps", "model", "threads"}``, ``t_s`` on the daemon's clock.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from zsched.host.clock import monotonic_s
from zsched_lab.fleet.signals import StopFlag

Frame = npt.NDArray[np.float32]
"""One camera frame: 1 x 3 x side x side, float32 in [0, 1]."""

REPORT_S = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Network:
    """A network ready to run: its honest name and the call for one frame."""

    name: str
    infer: Callable[[Frame], object]


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadOptions:
    """``threads`` >= 1; ``hz`` frames per second, 0 for as many as the CPU gives; ``side`` in pixels, times of 32."""

    threads: int = 1
    hz: float = 0.0
    side: int = 320
    duration_s: float | None = None


def package_file(package: str, *pattern: str) -> Path | None:
    """The first file matching ``pattern`` inside an installed package, found without importing it; or ``None``."""
    spec = importlib.util.find_spec(package)
    if spec is None:
        return None
    for folder in spec.submodule_search_locations or ():
        found = sorted(Path(folder).glob("/".join(pattern)))
        if found:
            return found[0]
    return None


def candidates() -> Iterator[tuple[str, Path]]:
    """The network files on this machine, best first, each with the name to show."""
    detector = package_file("rapidocr", "models", "*det*.onnx")
    if detector is not None:
        yield f"text detector {detector.stem}", detector
    resnet = package_file("onnx", "backend", "test", "data", "light", "light_resnet50.onnx")
    if resnet is not None:
        yield "ResNet-50 graph (constant weights)", resnet


def onnx_network(name: str, path: Path, threads: int) -> Network | None:
    """The network in ``path`` on ``threads`` CPU threads, or ``None`` when onnxruntime is not there or refuses it."""
    try:
        import onnxruntime  # noqa: PLC0415 - optional: the synthetic network needs none
    except ImportError:
        return None
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = threads
    settings.inter_op_num_threads = 1
    settings.log_severity_level = 3
    # Idle threads of the pool must sleep, not spin: at a set frame rate the spinning would be the load.
    settings.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = onnxruntime.InferenceSession(str(path), settings, providers=["CPUExecutionProvider"])
    except Exception as error:  # noqa: BLE001 - onnxruntime's errors share no parent; the next network is tried
        sys.stderr.write(f"neural_load: {path} does not load ({error}); trying the next network\n")
        return None
    entry = session.get_inputs()[0]
    shape = [size if isinstance(size, int) else 0 for size in entry.shape]
    return Network(name=name, infer=lambda frame: session.run(None, {entry.name: fit(frame, shape)}))


def fit(frame: Frame, shape: list[int]) -> Frame:
    """Cut or tile ``frame`` to a network's fixed sizes (0 = any)."""
    wanted = [size or have for size, have in zip(shape, frame.shape, strict=True)]
    if wanted == list(frame.shape):
        return frame
    repeats = [-(-size // have) for size, have in zip(wanted, frame.shape, strict=True)]
    return np.tile(frame, repeats)[tuple(slice(0, size) for size in wanted)]


def synthetic_network() -> Network:
    """A convolution by matrix product in numpy, for machines with no network at hand; one thread."""
    kernel = np.random.default_rng(0).random((64, 27), dtype=np.float32)

    def infer(frame: Frame) -> object:
        windows = np.lib.stride_tricks.sliding_window_view(frame[0], (3, 3, 3)).reshape(-1, 27)
        return np.maximum(kernel @ windows.T, 0.0).sum()

    return Network(name="synthetic convolution (no network installed)", infer=infer)


def load_network(threads: int) -> Network:
    """The best network this machine has."""
    for name, path in candidates():
        network = onnx_network(name, path, threads)
        if network is not None:
            return network
    return synthetic_network()


def frames(side: int, count: int = 4) -> list[Frame]:
    """A few camera-like frames (noise), made once: the network's cost does not depend on what it sees."""
    generator = np.random.default_rng(1)
    return [generator.random((1, 3, side, side), dtype=np.float32) for _ in range(count)]


def run(network: Network, options: LoadOptions, stop: StopFlag, report: Callable[[dict[str, object]], None]) -> int:
    """Infer until ``stop`` or the duration's end; returns the number of frames. One report a second."""
    pictures = frames(options.side)
    start = reported = due = monotonic_s()
    total = since = 0
    while not stop.is_set:
        network.infer(pictures[total % len(pictures)])
        total += 1
        since += 1
        now = monotonic_s()
        if now - reported >= REPORT_S:
            fps = since / (now - reported)
            report({"t_s": now, "frames": total, "fps": round(fps, 2), "model": network.name})
            reported, since = now, 0
        if options.duration_s is not None and now - start >= options.duration_s:
            break
        due = pace(due, options.hz)
    return total


def pace(due: float, hz: float) -> float:
    """Sleep until the next frame is due and return that time; frames that were missed are skipped, not caught up."""
    if hz <= 0.0:
        return due
    now = monotonic_s()
    due = max(due + 1.0 / hz, now)
    time.sleep(due - now)
    return due


def parse(arguments: list[str]) -> LoadOptions:
    """The command line as options; argparse exits 2 on a wrong one."""
    parser = argparse.ArgumentParser(
        prog="python -m zsched_lab.fleet.neural_load", description="Real neural inference load."
    )
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--hz", type=float, default=0.0, help="frames per second, 0: as many as possible")
    parser.add_argument("--side", type=int, default=320, help="frame side in pixels (a multiple of 32)")
    parser.add_argument("--duration", type=float, default=None, help="seconds; default: until SIGTERM")
    given = parser.parse_args(arguments)
    if given.threads < 1 or given.hz < 0 or given.side < 32 or given.side % 32:
        parser.error("--threads must be >= 1, --hz >= 0 and --side a multiple of 32")
    return LoadOptions(threads=given.threads, hz=given.hz, side=given.side, duration_s=given.duration)


def main(arguments: list[str] | None = None) -> int:
    """Entry point: 0 after a stop signal or the duration's end."""
    options = parse(sys.argv[1:] if arguments is None else arguments)
    stop = StopFlag()
    stop.install()
    network = load_network(options.threads)

    def report(line: dict[str, object]) -> None:
        sys.stdout.write(json.dumps(line | {"threads": options.threads}) + "\n")
        sys.stdout.flush()

    total = run(network, options, stop, report)
    sys.stderr.write(f"neural_load: {total} frames of {network.name}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
