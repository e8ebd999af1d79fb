"""Files that a browser sends into the library: limited in size, checked, never overwriting."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from viser import UploadedFile, ViserServer
from viser._messages import FileTransferStartUpload

from avatar_core.errors import AvatarError, SurfaceError, one_line
from avatar_core.geometry.label_files import read_image, read_label_map
from avatar_core.geometry.surface import read_surface
from avatar_core.geometry.surface_formats import LABEL_MAPS, MESHES, SUFFIXES
from avatar_core.scene.recording import load_recording
from avatar_core.vademecum.storage import load_vademecum
from avatar_ros.framework.library import RefusedError, file_name
from avatar_ros.framework.reader import Reader
from avatar_ros.ui.scan.library import RECORDINGS
from avatar_ros.ui.server.index_page import MOST_SENT


def receive(
    folder: Path, reader: Reader, say: Callable[[str], None], name: str, content: bytes
) -> None:
    """Store a file; report in a line that it is checked, and the outcome."""
    say(f"checking {name} ...")
    try:
        store(folder, reader, name, content)
    except AvatarError as error:
        say(one_line(error))
    else:
        say(f"{name} is in the library")


def store(folder: Path, reader: Reader, name: str, content: bytes) -> None:
    """Write a file into the library, if the page can use it.

    Raises AvatarError, with nothing left behind, for a name that is no file's or is taken, and for
    a
    file that cannot be read.
    """
    file_name(name)  # refuses a path
    if not name.endswith(".h5") and not name.lower().endswith(SUFFIXES):
        kinds = ", ".join((".h5", *MESHES, *LABEL_MAPS))
        raise RefusedError(f"{name}: neither organ nor image; send one of {kinds}")
    path = folder / name
    if path.exists():
        raise _taken(name)
    try:
        with TemporaryDirectory(dir=folder, prefix=".") as own:
            sent = Path(own) / name
            sent.write_bytes(content)
            reader.read(name, len(content), check, sent)
            with path.open("xb"):  # fails if another file came meanwhile
                os.replace(sent, path)
    except FileExistsError as error:
        raise _taken(name) from error
    except OSError as error:
        raise RefusedError(f"{name}: cannot be written, {error.strerror}; free space") from error
    except AvatarError as error:
        raise RefusedError(f"not stored: {str(error).replace(f'{own}/', '')}") from error


def check(path: Path) -> None:
    """Raise AvatarError for a file that is damaged, or not what its name says."""
    if path.suffix == ".h5":
        (load_recording if path.match(RECORDINGS) else load_vademecum)(path)
    elif path.name.lower().endswith(MESHES):
        read_surface(path, check_size=False)  # its unit is given with a build
    else:
        try:
            read_image(path)
        except SurfaceError:  # e.g. a segmentation of several layers
            read_label_map(path)


def _taken(name: str) -> RefusedError:
    return RefusedError(f"{name} is in the library already; send it under another name")


def take(button: Any) -> tuple[str, bytes]:
    """Take name and content of a sent file from a button, which then forgets it."""
    sent: UploadedFile = button.value
    button._impl.value = UploadedFile("", b"")
    return sent.name, sent.content


def bound(server: ViserServer) -> None:
    """Limit files to ``MOST_SENT`` bytes: viser itself keeps all in memory."""
    gui: Any = server.gui

    def start(client: Any, message: FileTransferStartUpload) -> None:
        if message.size_bytes <= MOST_SENT:
            gui._handle_file_transfer_start(client, message)

    gui._websock_interface.unregister_handler(FileTransferStartUpload)
    gui._websock_interface.register_handler(FileTransferStartUpload, start)
