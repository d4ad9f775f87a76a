"""The software bill of materials out of a lock file."""

from __future__ import annotations

import json

from sbom import document, pins

LOCK = """\
# by make lock
cffi==2.1.1 ; platform_python_implementation != 'PyPy' \\
    --hash=sha256:046b \\
    --hash=sha256:06c7
    # via cryptography
colorama==0.4.6 ; sys_platform == 'win32' \\
    --hash=sha256:0869
    # via typer
cryptography==50.0.2 \\
    --hash=sha256:0ddc
    # via zsched (pyproject.toml)
typer==0.29.2 \\
    --hash=sha256:0ddd
    # via
    #   cffi
    #   zsched (pyproject.toml)
"""


def test_a_lock_names_releases_and_who_needs_them() -> None:
    found = [(pin.name, pin.version, pin.needed_by) for pin in pins(LOCK)]
    assert found == [
        ("cffi", "2.1.1", ["cryptography"]),
        ("cryptography", "50.0.2", ["zsched"]),
        ("typer", "0.29.2", ["cffi", "zsched"]),
    ]


def test_the_same_lock_and_version_are_the_same_document() -> None:
    assert document("1.2.3", LOCK) == document("1.2.3", LOCK) != document("1.2.4", LOCK)
    needs = {one["ref"]: one["dependsOn"] for one in json.loads(document("1.2.3", LOCK))["dependencies"]}
    assert needs["pkg:pypi/zsched@1.2.3"] == ["pkg:pypi/cryptography@50.0.2", "pkg:pypi/typer@0.29.2"]
    assert needs["pkg:pypi/cryptography@50.0.2"] == ["pkg:pypi/cffi@2.1.1"]
