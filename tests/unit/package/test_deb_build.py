"""How the Debian package is put together: versions, glibc, wheels."""

from __future__ import annotations

import io
import re
import shutil
import subprocess
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

from support.packages import builder

REPO = Path(__file__).parents[3]
BUILD = builder()


@pytest.mark.parametrize(
    ("version", "debian"),
    [("0.1.dev12+gabc", "0.1~dev12+gabc"), ("1.0rc1", "1.0~rc1"), ("1.0", "1.0"), ("1.0.post1", "1.0.post1")],
)
def test_what_comes_before_a_release_is_before_it_for_dpkg(version: str, debian: str) -> None:
    assert BUILD.debian_version(version) == debian
    if shutil.which("dpkg") and "~" in debian:
        release = re.split("~", debian)[0]
        assert (
            subprocess.run(["dpkg", "--compare-versions", debian, "lt", release], timeout=20, check=False).returncode
            == 0
        )


def wheel_of(folder: Path, tag: str, files: dict[str, str]) -> Path:
    path = folder / f"lib-1-{tag}.whl"
    with zipfile.ZipFile(path, "w") as archive:
        for name, text in files.items():
            archive.writestr(name, text)
    return path


def test_wheels_for_two_pythons_lie_side_by_side(tmp_path: Path) -> None:
    payload = BUILD.Payload(tmp_path / "root")
    for minor, glibc in ((311, "2_17"), (312, "2_28")):
        files = {
            "lib/__init__.py": "",
            f"lib/c.cpython-{minor}.so": str(minor),
            "lib-1.dist-info/RECORD": f"lib/{minor}\n",
        }
        payload.unpack(wheel_of(tmp_path, f"cp{minor}-cp{minor}-manylinux_{glibc}_x86_64", files))
    assert {path.name for path in (payload.site / "lib").iterdir()} == {
        "__init__.py",
        "c.cpython-311.so",
        "c.cpython-312.so",
    }
    assert (payload.site / "lib-1.dist-info/RECORD").read_text() == "lib/311\nlib/312\n"
    assert payload.glibc == (2, 28)


def test_wheels_that_differ_in_their_python_are_refused(tmp_path: Path) -> None:
    payload = BUILD.Payload(tmp_path / "root")
    payload.unpack(wheel_of(tmp_path, "cp311-cp311-manylinux2014_x86_64", {"lib/a.py": "1"}))
    with pytest.raises(BUILD.BuildError, match=r"lib/a\.py differs between versions of Python"):
        payload.unpack(wheel_of(tmp_path, "cp312-cp312-manylinux2014_x86_64", {"lib/a.py": "2"}))


def test_a_wheel_that_leads_out_of_its_folder_is_refused(tmp_path: Path) -> None:
    payload = BUILD.Payload(tmp_path / "root")
    with pytest.raises(BUILD.BuildError, match="leads out"):
        payload.unpack(wheel_of(tmp_path, "py3-none-any", {"../../etc/passwd": "x"}))


def tarball(path: Path, *names: str) -> Path:
    with tarfile.open(path, "w:gz") as archive:
        for name in names:
            info = tarfile.TarInfo(name)
            info.size = 1
            archive.addfile(info, io.BytesIO(b"x"))
    return path


def test_a_private_python_is_known_by_its_program_and_loses_what_no_robot_needs(tmp_path: Path) -> None:
    names = (
        "bin/python3.12",
        "lib/python3.12/os.py",
        "lib/python3.12/test/big.py",
        "include/Python.h",
        "lib/libtcl8.a",
    )
    file = tarball(tmp_path / "dist.tar.gz", *(f"python/{name}" for name in names))
    assert BUILD.dist_python(file) == "3.12"
    BUILD.private_python(file, "3.12", tmp_path)
    left = {str(path.relative_to(tmp_path / "python")) for path in (tmp_path / "python").rglob("*") if path.is_file()}
    assert left == {"bin/python3.12", "lib/python3.12/os.py"}


def test_a_private_python_that_will_not_do_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BUILD.BuildError, match=r"no python/bin/python3\.x in it"):
        BUILD.dist_python(tarball(tmp_path / "a.tar.gz", "usr/bin/python3.12"))
    with pytest.raises(BUILD.BuildError, match=r"zsched is packed for 3\.11"):
        BUILD.dist_python(tarball(tmp_path / "b.tar.gz", "python/bin/python3.10"))
    (tmp_path / "c").write_text("x")
    with pytest.raises(BUILD.BuildError, match="no tarball of Python"):
        BUILD.dist_python(tmp_path / "c")


def test_the_lock_pins_every_release_with_hashes_and_what_pyproject_asks_for() -> None:
    lock = (REPO / "package/requirements.lock").read_text()
    blocks = [block for block in re.split(r"\n(?=[a-z])", lock) if "==" in block]
    assert len(blocks) > 10
    assert [block.split()[0] for block in blocks if "--hash=sha256:" not in block] == []
    asked = tomllib.loads((REPO / "pyproject.toml").read_text())["project"]["dependencies"]
    names = {re.split(r"[<>=]", one)[0].replace(".", "-") for one in asked}
    assert {block.split("==")[0] for block in blocks if "zsched (pyproject.toml)" in block} == names
