"""The remote of each scheme; its library is imported when a URL of that scheme is opened."""

from __future__ import annotations

from manip_il.store.remote import Remote, RemoteUrl


def open_remote(url: RemoteUrl, *, private: bool = False) -> Remote:
    """Return the remote of a URL, without connecting yet. private: of a repository that a push creates on the Hub."""
    if url.scheme == "hf":
        from manip_il.store.hub import HubRemote

        return HubRemote(url, private)
    if url.scheme == "s3":
        from manip_il.store.s3_store import S3Blobs as Blobs
    elif url.scheme == "sftp":
        from manip_il.store.sftp_store import SftpBlobs as Blobs
    else:
        from manip_il.store.file_store import FileBlobs as Blobs
    from manip_il.store.object_store import ObjectRemote

    return ObjectRemote(Blobs(url))
