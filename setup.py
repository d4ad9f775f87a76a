"""What pyproject.toml cannot say: the wheel brings its software bill of materials (PEP 770)."""

import sys
from pathlib import Path
from typing import Any

from setuptools import setup
from setuptools.command.bdist_wheel import bdist_wheel

sys.path.insert(0, str(Path(__file__).parent / "package"))
from sbom import FILE, document

LOCK = Path(__file__).parent / "package" / "requirements.lock"


class WheelWithSbom(bdist_wheel):  # type: ignore[misc]  # it has no types
    """A wheel whose `dist-info` has the SBOM."""

    def write_wheelfile(self, wheelfile_base: str, *arguments: Any, **options: Any) -> None:
        """Write it beside WHEEL, before the list of files (RECORD) is made."""
        super().write_wheelfile(wheelfile_base, *arguments, **options)
        folder = Path(wheelfile_base) / "sboms"
        folder.mkdir(exist_ok=True)
        text = document(self.distribution.get_version(), LOCK.read_text(encoding="utf-8"))
        (folder / FILE).write_text(text, encoding="utf-8")


setup(cmdclass={"bdist_wheel": WheelWithSbom})
