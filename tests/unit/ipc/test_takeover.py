"""What the digest of a relay's code is made of."""

from __future__ import annotations

from zsched.ipc.takeover import PACKAGE, code_digest, code_files


def test_the_digest_covers_what_daemon_and_relay_run_and_nothing_else() -> None:
    """A relay of other code is replaced; one whose command line or lab alone is newer goes on."""
    names = {str(path.relative_to(PACKAGE)) for path in code_files()}
    assert {"daemon.py", "relay/process.py", "core/values/plan.py", "hop/acknowledger.py", "wire/codec.py"} <= names
    assert not {
        name for name in names if name.startswith(("tasks/", "examples/", "dev/", "commands/")) or name == "cli.py"
    }
    assert len(code_digest()) == 16
