"""Push and pull of datasets and policies: `manip-il push FOLDER REMOTE` and `manip-il pull REMOTE FOLDER`.

A remote is the Hugging Face Hub, an S3 bucket, a folder on an SSH server, or a folder of this machine. This package
moves a folder there and back, and promises the following of each.

**An unfinished push is never visible.** Readers see the old version until every file of the new one is on the remote
and verified; then one step switches all of them over. On S3, SFTP and folders, files are objects named by their sha256
and never changed, and the step replaces the one manifest that names them. On the Hub the step is one commit. A push
that is killed, cut or refused leaves readers the version that they had. A new push uploads only what is missing, and
continues large S3 uploads at the first part that is missing.

**A pull is whole or resumes.** Files arrive in a hidden folder beside the target, `.NAME.pulling`. Each is hashed on
its way; a file that was cut continues at the byte where it ended. The target appears by one rename after every file
is verified and on the disk. A pull that is killed leaves no target, and the next one reuses what has arrived. The
replaced version's objects stay on the remote until the next push, so a pull that has begun can finish.

**Everything from outside is checked.** A manifest, a list of files and every other answer of a server may be hostile.
`manifest.FileEntry` and `manifest.Manifest` refuse themselves on construction: paths that leave the folder, links,
pickles, code, names that are equal on some file system, impossible sizes and hashes. Bytes count only once their hash
is right. Answers have a largest size, a longest time and a least speed, lists a largest number of pages. Nothing that
was pulled is executed. Whatever a server sends, a command ends with one line that says what to do.

**Secrets are never printed.** Every `RemoteError` removes tokens, keys, passwords and signatures from its text. A URL
is printed without its password. The Hub's token goes to the origin of HF_ENDPOINT alone and no S3 request follows a
redirect to another origin. Cards contain no absolute path and nothing that looks like a secret.

**Locks let one of two pushes win.** A push names the version that it read, and the remote switches only from that
version; otherwise `ConflictError` tells the user to push again.

    Hub      a commit on top of the parent that was read
    S3       If-Match and If-None-Match; a store that ignores them is found by a probe, and the user is warned
    SFTP     a lock file, made only where there is none and touched every 3 s; one not touched for 15 s is removed
    folder   the kernel's lock on the manifest, which a killed process cannot keep; without locks the user is warned

`push` and `pull` are the two procedures, for any `remote.Remote`. One is the Hub (`hub`, on top of `hub_repo`,
`hub_session` and `hub_http`); the other is `object_store`, on top of any store of plain files (`Blobs`): `s3_store`,
`sftp_store`, `file_store`. `schemes` opens the one that a URL names; the others know nothing of each other. `folder`
lists what is pushed; `cards` and `card_dataset` make what the Hub shows of it.

Importing this package does nothing; each remote's library is imported when a URL of its scheme is opened.
"""
