"""A board with a pattern (ChArUco): the sheet to print, and its corners in pictures."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from manip_il.mdp import F64

SQUARES = 6, 8  # across and up
SQUARE = 0.03  # side of a square [m]
_MARKER = 0.73  # side of a marker, as a share of a square's
_DICTIONARY = cv2.aruco.DICT_4X4_50
_SHEET = 0.21, 0.297  # A4 [m]
_RULER = 0.1  # length of the line to check the print with [m]
_INCH = 0.0254  # [m]
_DOTS = 1200  # pixels of the pattern's longer side


def pattern(square: float = SQUARE) -> Any:
    """Return OpenCV's board with squares of a side [m]."""
    dictionary = cv2.aruco.getPredefinedDictionary(_DICTIONARY)
    return cv2.aruco.CharucoBoard(SQUARES, square, _MARKER * square, dictionary)


def draw_sheet(path: Path) -> None:
    """Write the board as a PDF of A4 at true size, with a ruler to check the print with."""
    from matplotlib.figure import Figure

    picture = pattern().generateImage((_DOTS * SQUARES[0] // SQUARES[1], _DOTS))
    width, height = (count * SQUARE for count in SQUARES)
    sheet = Figure((_SHEET[0] / _INCH, _SHEET[1] / _INCH))
    axes = sheet.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, _SHEET[0]), ylim=(0, _SHEET[1]))
    axes.axis("off")
    left, low = (_SHEET[0] - width) / 2, (_SHEET[1] - height) / 2 + 0.01
    axes.imshow(
        picture, "gray", extent=(left, left + width, low, low + height), interpolation="nearest"
    )
    axes.set(xlim=(0, _SHEET[0]), ylim=(0, _SHEET[1]))
    axes.plot([left, left + _RULER], [0.02, 0.02], "|-k", linewidth=0.8)
    axes.text(
        left + _RULER + 0.005,
        0.02,
        "100 mm: print at true size; if the line is longer or shorter, say so with --ruler",
        fontsize=7,
        va="center",
    )
    sheet.savefig(path, format="pdf", metadata={"CreationDate": None})


def corners_in(picture: NDArray[np.uint8], square: float = SQUARE) -> tuple[F64, F64]:
    """Find the board's inner corners in a picture.

    Args:
        picture: The picture, (height, width, 3).
        square: Side of a square as printed [m].

    Returns:
        Positions on the board, (c, 3) [m], and in the picture, across and down, (c, 2) [pixels].
    """
    board = pattern(square)
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    pixels, numbers, *_ = cv2.aruco.CharucoDetector(board).detectBoard(grey)
    if numbers is None:
        return np.zeros((0, 3)), np.zeros((0, 2))
    places = np.asarray(board.getChessboardCorners(), float)[numbers[:, 0]]
    # pixels' centres are whole numbers in OpenCV; here a picture begins at 0
    return places, pixels[:, 0].astype(float) + 0.5
