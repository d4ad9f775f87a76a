"""The wheel of this tree, built and read back: version, SBOM, what it brings."""

from __future__ import annotations

import base64
import csv
import hashlib
import io
import json
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest
from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator

from support.packages import own_wheel

REPO = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def wheel() -> zipfile.ZipFile:
    """Built by the program that `make wheel` runs."""
    return zipfile.ZipFile(own_wheel())


def text_of(wheel: zipfile.ZipFile, ending: str) -> str:
    (name,) = (name for name in wheel.namelist() if name.endswith(ending))
    return wheel.read(name).decode()


def sbom_of(wheel: zipfile.ZipFile) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(text_of(wheel, ".dist-info/sboms/zsched.cdx.json"))
    return found


def test_the_version_is_gits_and_one_everywhere(wheel: zipfile.ZipFile) -> None:
    metadata = text_of(wheel, ".dist-info/METADATA")
    version = next(line for line in metadata.splitlines() if line.startswith("Version: ")).removeprefix("Version: ")
    assert f'__version__ = "{version}"' in text_of(wheel, "zsched/_version.py")
    assert sbom_of(wheel)["metadata"]["component"]["version"] == version
    if shutil.which("git") and (REPO / ".git").exists():
        command = ["git", "-C", str(REPO), "rev-parse", "--short=7", "HEAD"]
        head = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout.strip()
        tags = subprocess.run(
            ["git", "-C", str(REPO), "tag", "--points-at", "HEAD"],
            capture_output=True,
            text=True,
            timeout=60,
            check=True,
        ).stdout
        assert f"g{head}" in version or version in tags


def test_of_a_tagged_commit_the_version_is_the_tag(tmp_path: Path) -> None:
    """Git must take the copy that a wheel is built from for the clean tree that it is of, links and all."""
    if not (shutil.which("git") and (REPO / ".git").exists()):
        pytest.skip("this tree is not git's")
    tree = tmp_path / "tree"
    for arguments in (("clone", "--quiet", "--no-tags", str(REPO), str(tree)), ("-C", str(tree), "tag", "v9.8.7")):
        subprocess.run(["git", *arguments], timeout=60, check=True)
    shutil.copy(REPO / "package/wheel.py", tree / "package/wheel.py")
    subprocess.run(
        ["git", "-C", str(tree), "update-index", "--assume-unchanged", "package/wheel.py"], timeout=60, check=True
    )
    ask = "import sys, wheel; from pathlib import Path; print(wheel.copied(Path(sys.argv[1])))"
    told = [[sys.executable, "-c", ask, str(tmp_path)], [sys.executable, "-m", "setuptools_scm"]]
    places = [tree / "package", tmp_path / "source"]
    for command, place in zip(told, places, strict=True):
        done = subprocess.run(command, cwd=place, capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "9.8.7"


def test_the_sbom_is_cyclonedx_and_names_what_the_wheel_needs(wheel: zipfile.ZipFile) -> None:
    body = sbom_of(wheel)
    assert JsonStrictValidator(SchemaVersion.V1_6).validate_str(json.dumps(body)) is None
    names = {one["name"] for one in body["components"]}
    assert {"eclipse-zenoh", "msgpack", "cryptography", "ruamel-yaml", "typer"} <= names
    needs = {one["ref"]: one["dependsOn"] for one in body["dependencies"]}
    direct = {
        ref.removeprefix("pkg:pypi/").partition("@")[0] for ref in needs[body["metadata"]["component"]["bom-ref"]]
    }
    metadata = text_of(wheel, ".dist-info/METADATA").splitlines()
    wanted = {
        line.removeprefix("Requires-Dist: ").partition(">")[0].replace(".", "-").partition("<")[0]
        for line in metadata
        if line.startswith("Requires-Dist: ") and "extra ==" not in line
    }
    assert direct == wanted, "write package/requirements.lock anew: make lock"


def test_every_file_is_in_the_record_with_its_hash(wheel: zipfile.ZipFile) -> None:
    rows = {row[0]: row[1] for row in csv.reader(io.StringIO(text_of(wheel, ".dist-info/RECORD")))}
    for name in wheel.namelist():
        if not name.endswith("/RECORD"):
            digest = base64.urlsafe_b64encode(hashlib.sha256(wheel.read(name)).digest()).rstrip(b"=").decode()
            assert rows[name] == f"sha256={digest}", name


def test_it_brings_what_zsched_install_and_the_package_lay_out(wheel: zipfile.ZipFile) -> None:
    share = {name.partition(".data/data/share/")[2] for name in wheel.namelist() if ".data/data/share/" in name}
    units = {f"zsched/{name}" for name in ("zsched.service", "zsched-web.service", "zsched-renew.timer")}
    assert units | {"zsched/zsched.sysusers", "man/man1/zsched-install.1", "doc/zsched/install.md"} <= share
    names = set(wheel.namelist())
    assert {"zsched/commands/completions/zsched", "zsched/schemas/zsched.status.1.json"} <= names
    assert not [name for name in names if name.startswith(("package/", "tests/", "lab/"))]
