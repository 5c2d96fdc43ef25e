"""The files of an image as a read-only file system of MicroPython, so that its modules are imported from the image."""

import io

from . import image

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import BinaryIO

_CLOSE, _BUFFER_SIZE = 4, 11  # requests to ``ioctl`` of a stream
_FOLDER, _FILE = 0x4000, 0x8000  # st_mode
_PART = 255


class ImageFile(io.IOBase):
    """One open file: ``size`` bytes from ``offset`` of the image."""

    def __init__(self, file: "BinaryIO", offset: int, size: int) -> None:
        file.seek(offset)
        self._file, self._left = file, size

    def readinto(self, buffer: bytearray) -> int:
        """Read up to the size of the buffer; return the number of bytes, 0 at the end."""
        part = self._file.read(min(len(buffer), self._left))
        buffer[: len(part)] = part
        self._left -= len(part)
        return len(part)

    def ioctl(self, request: int, _argument: int) -> int:
        """Close the file, or name the size in which to read it."""
        if request == _CLOSE:
            self._file.close()
        return _PART if request == _BUFFER_SIZE else 0


class ImageFiles:
    """A file system for ``vfs.mount``. ``open_image`` opens the image."""

    def __init__(self, open_image: "Callable[[], BinaryIO]") -> None:
        self._open_image = open_image
        self._files: "dict[str, tuple[int, int]]" = {}
        self._folders: "set[str]" = set()
        with open_image() as file:
            for path, offset, size in image.files(file):
                self._files[path] = offset, size
                parts = path.split("/")
                for depth in range(1, len(parts)):
                    self._folders.add("/".join(parts[:depth]))

    def mount(self, *_arguments: bool) -> None:
        """Do nothing: MicroPython calls it."""

    umount = mount

    def stat(self, path: str) -> "tuple[int, ...]":
        """Return the type and size of a file or folder. Raises OSError if there is none."""
        path = path.strip("/")
        if path in self._folders:
            return (_FOLDER,) + (0,) * 9
        if path not in self._files:
            raise OSError(2)
        return (_FILE, 0, 0, 0, 0, 0, self._files[path][1], 0, 0, 0)

    def open(self, path: str, _mode: str) -> ImageFile:
        """Open a file. Raises OSError if there is none."""
        found = self._files.get(path.strip("/"))
        if found is None:
            raise OSError(2)
        return ImageFile(self._open_image(), found[0], found[1])
