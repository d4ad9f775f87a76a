"""Certificates for one test, made by openssl: an authority, and one for all of this machine's addresses."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import psutil
import pytest

from zsched_lab.fleet.loopback import own_address


def make_tls(folder: Path) -> Path:
    """A zenoh file with TLS both ways: who has no certificate of this authority is not let in."""
    if shutil.which("openssl") is None:
        pytest.skip("there is no openssl, which makes the certificates")
    interfaces = [one.address for found in psutil.net_if_addrs().values() for one in found]
    addresses = {own_address(), "127.0.0.1", *(one for one in interfaces if one.count(".") == 3)}
    names = "subjectAltName=" + ",".join(f"IP:{one}" for one in sorted(addresses))
    authority = ["-subj", "/CN=test authority", "-addext", "basicConstraints=critical,CA:TRUE"]
    _openssl(folder, "req", "-x509", *_new("ca"), *authority, "-out", "ca.pem", "-days", "2")
    _openssl(folder, "req", *_new("node"), "-subj", "/CN=node", "-out", "node.csr")
    (folder / "names").write_text(names)
    signed = ["-in", "node.csr", "-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial", "-extfile", "names"]
    _openssl(folder, "x509", "-req", *signed, "-out", "node.pem", "-days", "2")
    tls = {
        "root_ca_certificate": str(folder / "ca.pem"),
        "enable_mtls": True,
        "listen_certificate": str(folder / "node.pem"),
        "listen_private_key": str(folder / "node.key"),
        "connect_certificate": str(folder / "node.pem"),
        "connect_private_key": str(folder / "node.key"),
    }
    file = folder / "zenoh.json5"
    file.write_text(json.dumps({"transport": {"link": {"tls": tls}}}))
    return file


def _new(name: str) -> list[str]:
    return ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-keyout", f"{name}.key"]


def _openssl(folder: Path, *words: str) -> None:
    done = subprocess.run(["openssl", *words], cwd=folder, capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == 0, done.stderr
