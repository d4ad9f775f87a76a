"""The share of time in which the GPU worked: by sysfs (Jetson, amdgpu), or by the library of NVIDIA's driver (NVML).

Knows: Jetson's ``load`` (per mille), five functions of ``libnvidia-ml.so.1``, amdgpu's ``gpu_busy_percent``. Of several
GPUs of one maker the freest counts. Does not know: which process uses how much.

On a Jetson NVML finds a GPU and answers "not supported", so its file goes first. amdgpu counts where NVML knows no
card: a processor's own GPU idles beside the card that does the work. NVML is called by ctypes: five calls need no
bindings. The library is loaded only where the driver is. What it has opened tells nothing any more once the driver was
reset or loaded anew, so it is opened again then.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from zsched.host.machine.gauges import number

JETSON = (
    "sys/devices/gpu.0/load",
    "sys/devices/platform/gpu.0/load",
    *(f"sys/class/devfreq/*{chip}/device/load" for chip in (".gpu", "gm20b", "gp10b", "gv11b", "ga10b")),
)
AMD = "sys/class/drm/card*/device/gpu_busy_percent"
DRIVER = "proc/driver/nvidia/version"
LIBRARY = "libnvidia-ml.so.1"
NOT_SUPPORTED = 3
"""``NVML_ERROR_NOT_SUPPORTED``: a GPU that is well, and does not tell this."""


class Reader:
    """The freest GPU's use in [0, 1]."""

    def __init__(self, root: Path, library: str = LIBRARY) -> None:
        """Files below ``root``; NVML's ``library``."""
        self._root, self._library = root, library
        self._nvml: _Nvml | None = None

    def read(self) -> float | None:
        """``None`` without a GPU that reports its use."""
        loads = [load / 1000.0 for file in self._found(*JETSON) if (load := number(file)) is not None]
        if not loads and (self._root / DRIVER).exists():
            self._nvml = self._nvml or _Nvml(self._library)
            loads = self._nvml.loads()
            has_cards = self._nvml.count > 0 or self._nvml.is_lost
            if self._nvml.is_lost:
                self._nvml.close()
                self._nvml = None
            if has_cards:
                return min(loads, default=None)
        if not loads:
            loads = [busy / 100.0 for file in self._found(AMD) if (busy := number(file)) is not None]
        return min(loads, default=None)

    def _found(self, *patterns: str) -> list[Path]:
        return [file for pattern in patterns for file in self._root.glob(pattern)]


class _Nvml:
    """NVML, from its library's start until `close`."""

    def __init__(self, library: str) -> None:
        """Raises `OSError` when the library is not there or does not start."""
        import ctypes  # noqa: PLC0415 - only where there is such a driver

        class Rates(ctypes.Structure):
            """``nvmlUtilization_t``: percent of the time."""

            _fields_ = (("gpu", ctypes.c_uint), ("memory", ctypes.c_uint))

        self._c: Any = ctypes
        self._rates: Any = Rates
        self._lib: Any = ctypes.CDLL(library)
        self.count = 0
        """How many GPUs it has told of."""
        self.is_lost = False
        """No GPU has told anything at the last question, and not for want of support: it may be open in vain."""
        code = self._lib.nvmlInit_v2()
        if code:
            raise OSError(f"NVML does not start: error {code}")

    def close(self) -> None:
        """Give back what was opened: else the next start would go on with it."""
        self._lib.nvmlShutdown()

    def loads(self) -> list[float]:
        """Of every GPU that tells it."""
        count = self._c.c_uint()
        if self._lib.nvmlDeviceGetCount_v2(self._c.byref(count)):
            self.is_lost = True
            return []
        self.count = count.value
        told = [self._load(index) for index in range(count.value)]
        found = [busy for code, busy in told if code == 0]
        self.is_lost = not found and any(code != NOT_SUPPORTED for code, _ in told)
        return found

    def _load(self, index: int) -> tuple[int, float]:
        """(error, the use) of one GPU."""
        device, rates = self._c.c_void_p(), self._rates()
        code = self._lib.nvmlDeviceGetHandleByIndex_v2(self._c.c_uint(index), self._c.byref(device))
        code = code or self._lib.nvmlDeviceGetUtilizationRates(device, self._c.byref(rates))
        return int(code), rates.gpu / 100.0
