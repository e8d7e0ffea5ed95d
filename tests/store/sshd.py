"""Debian's sshd as a process of the tests: on loopback, any free port, one key, nothing of the machine's own."""

from __future__ import annotations

import contextlib
import getpass
import os
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

SSHD = "/usr/sbin/sshd"

_CONFIG = """\
ListenAddress 127.0.0.1
Port {port}
HostKey {folder}/host_key
AuthorizedKeysFile {folder}/user_key.pub
PidFile none
StrictModes no
UsePAM no
PasswordAuthentication no
KbdInteractiveAuthentication no
PubkeyAuthentication yes
PermitRootLogin prohibit-password
Subsystem sftp internal-sftp
{more}
"""


@dataclass(frozen=True)
class Sshd:
    """A running server. home: what HOME must be for its key and its name to be known."""

    port: int
    home: Path
    user: str

    def url(self, folder: Path) -> str:
        return f"sftp://{self.user}@127.0.0.1:{self.port}{folder}"


@contextlib.contextmanager
def running_sshd(folder: Path, more: str = "") -> Iterator[Sshd]:
    """more: lines of sshd_config."""
    if not Path(SSHD).is_file():
        raise RuntimeError(f"{SSHD} is missing: as root: .ci/system sshd")
    keygen = shutil.which("ssh-keygen") or "ssh-keygen"
    for name in ("host_key", "user_key"):
        subprocess.run([keygen, "-q", "-t", "ed25519", "-N", "", "-f", str(folder / name)], check=True)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    (folder / "sshd_config").write_text(_CONFIG.format(port=port, folder=folder, more=more))
    home = folder / "home"
    (home / ".ssh").mkdir(parents=True)
    key, kind, *_ = reversed((folder / "host_key.pub").read_text().split()[:2])
    (home / ".ssh" / "known_hosts").write_text(f"[127.0.0.1]:{port} {kind} {key}\n")
    (home / ".ssh" / "config").write_text(f"Host 127.0.0.1\n  IdentityFile {folder}/user_key\n")
    with contextlib.suppress(PermissionError):  # where it drops its rights to, if it is started as root
        Path("/run/sshd").mkdir(exist_ok=True)
    with (folder / "log").open("wb") as log:
        server = subprocess.Popen([SSHD, "-D", "-e", "-f", str(folder / "sshd_config")], stderr=log)
    try:
        _wait_for(port, server, folder / "log")
        yield Sshd(port, home, getpass.getuser() if "USER" in os.environ or os.getuid() else "root")
    finally:
        server.terminate()
        server.wait(120)


def _wait_for(port: int, server: subprocess.Popen[bytes], log: Path) -> None:
    last = time.monotonic() + 120
    while time.monotonic() < last and server.poll() is None:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 0.2):
            return
        time.sleep(0.05)
    raise RuntimeError(f"sshd did not start: {log.read_text(errors='replace')[-500:]}")
