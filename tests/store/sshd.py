"""Debian's sshd as a process of the tests: on loopback, any free port, one key, nothing of the machine's own."""

from __future__ import annotations

import contextlib
import getpass
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
PermitRootLogin prohibit-password
Subsystem sftp internal-sftp
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
def running_sshd(folder: Path) -> Iterator[Sshd]:
    if not Path(SSHD).is_file():
        raise RuntimeError(f"{SSHD} is missing: as root: .ci/system sshd")
    for name in ("host_key", "user_key"):
        subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(folder / name)], check=True)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    (folder / "sshd_config").write_text(_CONFIG.format(port=port, folder=folder))
    ssh = folder / "home" / ".ssh"
    ssh.mkdir(parents=True)
    kind, key, *_ = (folder / "host_key.pub").read_text().split()
    (ssh / "known_hosts").write_text(f"[127.0.0.1]:{port} {kind} {key}\n")
    (ssh / "config").write_text(f"Host 127.0.0.1\n  IdentityFile {folder}/user_key\n")
    with contextlib.suppress(PermissionError):  # where it drops its rights to, if it is started as root
        Path("/run/sshd").mkdir(exist_ok=True)
    with (folder / "log").open("wb") as log:
        server = subprocess.Popen([SSHD, "-D", "-e", "-f", str(folder / "sshd_config")], stderr=log)
    try:
        last = time.monotonic() + 60
        while socket.socket().connect_ex(("127.0.0.1", port)):
            assert server.poll() is None, (folder / "log").read_text(errors="replace")
            assert time.monotonic() < last
            time.sleep(0.05)
        yield Sshd(port, folder / "home", getpass.getuser())
    finally:
        server.terminate()
        server.wait(120)
