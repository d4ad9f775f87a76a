"""The programs by which tests try zsched against the real thing, and the Debian packages that have them."""

from __future__ import annotations

import shutil
from collections.abc import Mapping

from support import browser

PACKAGES: dict[tuple[str, ...], str] = {
    ("debootstrap",): "debootstrap",
    ("systemd-nspawn",): "systemd-container",
    ("nft",): "nftables",
    ("ip",): "iproute2",
    browser.NAMES: "chromium-headless-shell",
    ("openssl",): "openssl",
    ("promtool",): "prometheus",
    ("node",): "nodejs",
    ("tmux",): "tmux",
    ("man",): "man-db",
    ("zsh",): "zsh",
    ("fish",): "fish",
    ("cc",): "gcc",
}
"""{programs, one of which is enough: the package}."""


def to_install(packages: Mapping[tuple[str, ...], str] = PACKAGES) -> str:
    """The command that installs what is missing here; empty: nothing is."""
    missing = [package for names, package in packages.items() if not any(map(shutil.which, names))]
    return f"sudo apt-get install {' '.join(missing)}" if missing else ""
