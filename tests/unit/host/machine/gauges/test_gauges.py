"""Fake sysfs trees read by the real readers; NVML by a small library that is compiled here."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path

import psutil
import pytest

from zsched.core.profile.means import STALE_S
from zsched.host.clock import monotonic_s
from zsched.host.machine.gauges import LOOK_S, REST_S, GaugeWatch, battery, gpu, temperature_c

NVML = """
typedef struct { unsigned gpu, memory; } rates;
static unsigned use[] = {80, 35, 90};
static int opened, resets, seen;
static int lost(void) { return opened == 0 ? 1 : seen == resets ? 0 : 999; }
int nvmlInit_v2(void) { if (opened++ == 0) seen = resets; return INIT; }
int nvmlShutdown(void) { opened--; return 0; }
void reset(void) { resets++; }
int nvmlDeviceGetCount_v2(unsigned *count) { *count = 3; return COUNTS ? 0 : lost(); }
int nvmlDeviceGetHandleByIndex_v2(unsigned index, void **device)
{ *device = use + index; return lost() ? lost() : index == 2; }
int nvmlDeviceGetUtilizationRates(void *device, rates *told) { told->gpu = *(unsigned *)device; return RATES; }
"""


def tree(root: Path, **files: str) -> Path:
    """``a__b="text"`` becomes the file a/b."""
    for name, text in files.items():
        file = root / name.replace("__", "/")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return root


def supply(root: Path, name: str, **files: str) -> None:
    tree(root, **{f"sys__class__power_supply__{name}__{key}": f"{text}\n" for key, text in files.items()})


def test_a_battery_of_the_system_counts_and_a_mouse_does_not(tmp_path: Path) -> None:
    supply(tmp_path, "AC", type="Mains", online="1")
    supply(tmp_path, "hidpp_battery_0", type="Battery", scope="Device", capacity="5")
    assert battery.Reader(tmp_path).read() is None
    supply(tmp_path, "BAT0", type="Battery", capacity="84")
    assert battery.Reader(tmp_path).read() == pytest.approx(0.84)
    supply(tmp_path, "BAT1", type="Battery", energy_now="10000000", energy_full="50000000")
    assert battery.Reader(tmp_path).read() == pytest.approx(0.52)


def test_a_battery_whose_driver_says_nothing_or_nonsense_is_no_reading(tmp_path: Path) -> None:
    supply(tmp_path, "BAT0", type="Battery", charge_now="12", charge_full="0")
    assert battery.Reader(tmp_path).read() is None
    supply(tmp_path, "BAT0", capacity="full")
    assert battery.Reader(tmp_path).read() is None
    supply(tmp_path, "BAT0", capacity="104")
    assert battery.Reader(tmp_path).read() == 1.0


def zone(root: Path, number: int, kind: str, temp: str) -> None:
    tree(root, **{f"sys__class__thermal__thermal_zone{number}__{key}": text for key, text in {"type": kind}.items()})
    tree(root, **{f"sys__class__thermal__thermal_zone{number}__temp": temp})


def test_the_hottest_zone_counts_but_no_constant_and_none_that_is_off(tmp_path: Path) -> None:
    zone(tmp_path, 0, "cpu-thermal", "51500\n")
    zone(tmp_path, 1, "gpu-thermal", "-256000\n")
    zone(tmp_path, 2, "PMIC-Die", "100000\n")
    zone(tmp_path, 3, "iwlwifi_1", "\n")
    tree(tmp_path, sys__class__hwmon__hwmon0__temp1_input="70000")
    assert temperature_c.Reader(tmp_path).read() == 51.5


def test_a_processor_s_own_sensor_counts_beside_a_zone_of_the_firmware_s(tmp_path: Path) -> None:
    """On AMD's the only zone may stand at 32 °C for good; a board's open pin says 127 °C."""
    zone(tmp_path, 0, "acpitz", "32000\n")
    tree(tmp_path, sys__class__hwmon__hwmon0__name="nct6775\n", sys__class__hwmon__hwmon0__temp2_input="127000")
    assert temperature_c.Reader(tmp_path).read() == 32.0
    tree(tmp_path, sys__class__hwmon__hwmon1__name="k10temp\n", sys__class__hwmon__hwmon1__temp1_input="81125")
    assert temperature_c.Reader(tmp_path).read() == 81.125


@pytest.mark.parametrize(
    "place",
    [
        "sys/devices/gpu.0/load",
        "sys/devices/platform/gpu.0/load",
        "sys/class/devfreq/17000000.gpu/device/load",
        "sys/class/devfreq/17000000.ga10b/device/load",
    ],
)
def test_a_jetson_tells_its_load_in_per_mille(tmp_path: Path, place: str) -> None:
    tree(tmp_path, **{place.replace("/", "__"): "437\n"})
    assert gpu.Reader(tmp_path).read() == pytest.approx(0.437)


def test_of_two_radeons_the_freer_one_counts(tmp_path: Path) -> None:
    tree(
        tmp_path,
        sys__class__drm__card0__device__gpu_busy_percent="90\n",
        sys__class__drm__card1__device__gpu_busy_percent="12\n",
    )
    assert gpu.Reader(tmp_path).read() == pytest.approx(0.12)


def library(folder: Path, init: int = 0, rates: int = 0, *, counts: bool = False) -> str:
    """``counts``: it counts its GPUs, even if the driver was reset."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler here to make a library that answers as NVML")
    text = NVML.replace("INIT", str(init)).replace("RATES", str(rates)).replace("COUNTS", str(int(counts)))
    (folder / "nvml.c").write_text(text)
    made = folder / f"nvml{init}{rates}{int(counts)}.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-o", made, folder / "nvml.c"], check=True)
    return str(made)


def test_nvml_is_asked_where_the_driver_is_and_a_gpu_that_fails_is_left_out(tmp_path: Path) -> None:
    reader = gpu.Reader(tmp_path, library(tmp_path))
    assert reader.read() is None, "without the driver the library is not even loaded"
    tree(tmp_path, proc__driver__nvidia__version="NVRM\n")
    assert reader.read() == pytest.approx(0.35)


def test_the_processors_own_gpu_does_not_hide_the_card_beside_it(tmp_path: Path) -> None:
    idle = {"sys__class__drm__card1__device__gpu_busy_percent": "0\n"}
    tree(tmp_path, proc__driver__nvidia__version="NVRM\n", **idle)
    name = library(tmp_path)
    reader = gpu.Reader(tmp_path, name)
    assert reader.read() == pytest.approx(0.35)
    ctypes.CDLL(name).reset()
    assert reader.read() is None, "the card tells nothing for a moment: that does not make the machine idle"
    assert gpu.Reader(tmp_path, library(tmp_path, rates=3)).read() is None, "nor does a card that never tells its use"


def test_nvml_that_is_not_there_does_not_start_or_tells_nothing_is_no_reading(tmp_path: Path) -> None:
    tree(tmp_path, proc__driver__nvidia__version="NVRM\n")
    with pytest.raises(OSError, match="no-such-library"):
        gpu.Reader(tmp_path, "no-such-library.so.1").read()
    with pytest.raises(OSError, match="error 9"):
        gpu.Reader(tmp_path, library(tmp_path, init=9)).read()
    assert gpu.Reader(tmp_path, library(tmp_path, rates=3)).read() is None, "a Jetson's NVML: not supported"
    watch = GaugeWatch(tmp_path)
    zone(tmp_path, 0, "cpu", "40000")
    assert watch.look() == (("temperature_c", 40.0),), "one gauge that fails is one gauge that is not measured"


@pytest.mark.parametrize("counts", [False, True])
def test_nvml_is_opened_anew_once_the_driver_was_reset(tmp_path: Path, counts: bool) -> None:
    """What was opened before tells errors only; it must be given back, or it is not opened again."""
    tree(tmp_path, proc__driver__nvidia__version="NVRM\n")
    name = library(tmp_path, counts=counts)
    reader = gpu.Reader(tmp_path, name)
    assert reader.read() == pytest.approx(0.35)
    ctypes.CDLL(name).reset()
    assert reader.read() is None
    assert reader.read() == pytest.approx(0.35)


def test_readings_of_a_thread_that_hangs_grow_old(tmp_path: Path) -> None:
    zone(tmp_path, 0, "cpu", "40000")
    watch = GaugeWatch(tmp_path)
    assert watch.newest(monotonic_s()) == ()
    found = watch.look()
    assert watch.newest(monotonic_s()) == found != ()
    assert watch.newest(monotonic_s() + STALE_S + 0.1) == ()


def test_a_reading_that_a_driver_misses_leaves_the_one_before_for_as_long_as_it_is_young(tmp_path: Path) -> None:
    """A machine whose only gauge is its GPU lost its task to one failed reading: it was not looked at for 30 s."""
    zone(tmp_path, 0, "cpu", "40000")
    watch, waits, now = GaugeWatch(tmp_path), list[float](), monotonic_s()

    class Stop:
        def is_set(self) -> bool:
            return len(waits) == 2

        def wait(self, seconds: float) -> None:
            waits.append(seconds)
            (tmp_path / "sys/class/thermal/thermal_zone0/temp").unlink(missing_ok=True)

    watch._stop = Stop()  # type: ignore[assignment]
    watch._run()
    assert watch.look() == (), "it is missed from the second look on"
    assert waits == [LOOK_S, LOOK_S]
    assert watch.newest(now) == (("temperature_c", 40.0),)
    assert watch.newest(monotonic_s() + STALE_S + 0.1) == ()


def test_a_machine_that_has_never_had_a_gauge_is_seldom_looked_at(tmp_path: Path) -> None:
    watch, waits = GaugeWatch(tmp_path), list[float]()

    class Stop:
        def is_set(self) -> bool:
            return bool(waits)

        def wait(self, seconds: float) -> None:
            waits.append(seconds)

    watch._stop = Stop()  # type: ignore[assignment]
    watch._run()
    assert waits == [REST_S]


def test_this_machine_as_psutil_sees_it() -> None:
    charge, told = psutil.sensors_battery(), battery.Reader(Path("/")).read()
    assert (charge is None) == (told is None)
    if charge is not None and told is not None:
        assert told == pytest.approx(charge.percent / 100.0, abs=0.02)
