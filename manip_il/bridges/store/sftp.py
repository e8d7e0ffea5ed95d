"""Files on an SSH server; paramiko is an extra."""

import logging
from pathlib import Path
from typing import Any, override
from urllib.parse import unquote

import fsspec
import paramiko
from fsspec.implementations.sftp import SFTPFileSystem

TIMEOUT = 30.0  # for connecting, and for each response [s]


class Sftp(SFTPFileSystem):
    """SFTP with the user's ~/.ssh/config, to hosts in ~/.ssh/known_hosts only.

    Fsspec's class accepts any host key.
    """

    cachable = False
    put: Any = fsspec.AbstractFileSystem.put  # fsspec's SFTP class can put only a single file

    def _connect(self) -> None:
        # paramiko also raises the errors that it logs
        logging.getLogger("paramiko").setLevel(logging.CRITICAL)
        config, login = Path.home() / ".ssh" / "config", self.ssh_kwargs
        known = (
            dict(paramiko.SSHConfig.from_path(str(config)).lookup(self.host))
            if config.is_file()
            else {}
        )
        self.client = paramiko.SSHClient()
        self.client.load_system_host_keys()
        self.client.set_missing_host_key_policy(paramiko.RejectPolicy())
        self.client.connect(
            str(known.get("hostname", self.host.strip("[]"))),
            login.get("port") or int(known.get("port", 22)),
            login.get("username") or known.get("user"),
            unquote(login.get("password") or "") or None,
            key_filename=known.get("identityfile"),
            timeout=TIMEOUT,
        )
        self.ftp = self.client.open_sftp()
        self.ftp.get_channel().settimeout(TIMEOUT)  # pyright: ignore[reportOptionalMemberAccess]

    @override
    def put_file(
        self, lpath: Any, rpath: Any, callback: Any = None, mode: str = "", **kwargs: Any
    ) -> None:
        """Upload a file and make its folder.

        Args:
            lpath: The file on this machine.
            rpath: The path on the server.
            callback: Ignored.
            mode: Ignored.
            kwargs: Ignored.
        """
        self.makedirs(self._parent(rpath), exist_ok=True)
        self.ftp.put(str(lpath), str(rpath))

    @override
    def get_file(self, rpath: Any, lpath: Any, callback: Any = None, **kwargs: Any) -> None:
        """Download a file and count its bytes.

        Args:
            rpath: The path on the server.
            lpath: The new file on this machine.
            callback: The `Arrival` that counts the bytes.
            kwargs: Ignored.

        Raises:
            RemoteError: if the file has more bytes than expected.
        """
        with self.ftp.open(str(rpath)) as source:
            source.prefetch(min(source.stat().st_size or 0, callback.most))
            callback.copy(source, lpath)
