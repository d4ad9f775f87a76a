"""The software bill of materials (CycloneDX 1.6, JSON) of a wheel, out of the lock file (pure).

It names the releases that zsched is packed with, and which of them needs which. Whoever installs the wheel by pip may
get later ones. The same lock and version give the same bytes.
"""

from __future__ import annotations

import json
import re
import uuid
from collections.abc import Iterator
from dataclasses import dataclass, field

FILE = "zsched.cdx.json"
_PIN = re.compile(r"^(?P<name>[A-Za-z0-9._-]+)==(?P<version>[^ ;\\]+)(?: *; *(?P<marker>[^\\]+?))? *\\?$")
_OTHER_SYSTEMS = ("sys_platform == 'win32'",)
"""Markers of what no machine of ours gets."""
_SELF = "zsched"


@dataclass(slots=True)
class Pin:
    """One release of the lock."""

    name: str
    version: str
    needed_by: list[str] = field(default_factory=list)

    @property
    def purl(self) -> str:
        """Its name among all packages of the world."""
        return f"pkg:pypi/{self.name}@{self.version}"


def pins(lock: str) -> list[Pin]:
    """What the lock pins for Linux, in its order, with who needs it (the comments ``# via``)."""
    return list(_pins(lock))


def _pins(lock: str) -> Iterator[Pin]:
    pin: Pin | None = None
    for line in lock.splitlines():
        found = _PIN.match(line)
        if found is not None:
            if pin is not None:
                yield pin
            is_other = (found["marker"] or "").strip() in _OTHER_SYSTEMS
            pin = None if is_other else Pin(name=found["name"].lower(), version=found["version"])
        elif pin is not None and line.startswith("    #"):
            by = line.removeprefix("    #").strip().removeprefix("via").strip()
            pin.needed_by += [by.split(" ")[0]] if by else []
    if pin is not None:
        yield pin


def document(version: str, lock: str) -> str:
    """The SBOM of zsched's ``version`` with what ``lock`` pins."""
    found = pins(lock)
    own = f"pkg:pypi/{_SELF}@{version}"
    refs = {_SELF: own, **{pin.name: pin.purl for pin in found}}
    needs: dict[str, list[str]] = {ref: [] for ref in refs.values()}
    for pin in found:
        for by in pin.needed_by:
            needs[refs[by]].append(pin.purl)
    body = {
        "$schema": "http://cyclonedx.org/schema/bom-1.6.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "serialNumber": f"urn:uuid:{uuid.uuid5(uuid.NAMESPACE_URL, own + lock)}",
        "version": 1,
        "metadata": {
            "component": {
                "type": "application",
                "bom-ref": own,
                "name": _SELF,
                "version": version,
                "purl": own,
                "licenses": [{"license": {"id": "Apache-2.0"}}],
            }
        },
        "components": [
            {"type": "library", "bom-ref": pin.purl, "name": pin.name, "version": pin.version, "purl": pin.purl}
            for pin in found
        ],
        "dependencies": [{"ref": ref, "dependsOn": sorted(below)} for ref, below in needs.items()],
    }
    return json.dumps(body, indent=1) + "\n"
