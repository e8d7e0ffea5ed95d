"""A board with a pattern (ChArUco): the sheet to print, and its corners in pictures."""

import io
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from manip_il.mdp import F64

SQUARES = 6, 8  # across and up
SQUARE = 0.03  # side of a square [m]
RULER = 100.0  # length of the line on the sheet [mm]
_MARKER = 0.73  # side of a marker, as a share of a square's
_SHEET = 0.21, 0.297  # A4 [m]
_INCH = 0.0254  # [m]
_DOTS = 100  # pixels of a square
# the last markers of their dictionary, since boards of other programs have the first
_MARKERS = np.arange(26, 50)
_MAKER = "manip-il robot board"


def pattern(square: float = SQUARE) -> Any:
    """Return OpenCV's board with squares of a side [m]."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    return cv2.aruco.CharucoBoard(SQUARES, square, _MARKER * square, dictionary, _MARKERS)


def drawn() -> NDArray[np.uint8]:
    """Return the board as a grey picture, (height, width)."""
    return pattern().generateImage([_DOTS * count for count in SQUARES])


def sheet() -> bytes:
    """Return a PDF of the board on A4 at true size, with a ruler to check the print."""
    figure = Figure((_SHEET[0] / _INCH, _SHEET[1] / _INCH))
    axes = figure.add_axes((0, 0, 1, 1))
    width, height = (count * SQUARE for count in SQUARES)
    left = (_SHEET[0] - width) / 2
    low = 0.045  # lower edge of the board [m]
    line = 0.025  # height of the ruler [m]
    edges = (left, left + width, low, low + height)
    axes.imshow(drawn(), "gray", extent=edges, interpolation="nearest")
    axes.set(xlim=(0, _SHEET[0]), ylim=(0, _SHEET[1]))
    axes.axis("off")
    end = left + RULER / 1e3
    axes.plot([left, end], [line, line], "|-k", linewidth=0.8, markersize=12, markeredgewidth=0.8)
    words = f"{RULER:.0f} mm; print at 100 %, and if the line is\nlonger or shorter, give --ruler="
    axes.text(end + 0.005, line, words, fontsize=7, va="center")
    content = io.BytesIO()
    figure.savefig(content, format="pdf", metadata={"CreationDate": None, "Creator": _MAKER})
    return content.getvalue()


def corners_in(picture: NDArray[np.uint8], square: float) -> tuple[F64, F64, int]:
    """Find the board's inner corners in a picture.

    Args:
        picture: The picture, RGB, (height, width, 3).
        square: Side of a square as printed [m].

    Returns:
        Positions on the board, x across, y up and z out of it, (c, 3) [m]; in the picture, across
        and down from its upper left, (c, 2) [pixels]; and the number of markers of any board.
    """
    board = pattern(square)
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    found: Any = cv2.aruco.CharucoDetector(board).detectBoard(grey)
    pixels, numbers, _, markers = found
    count = 0 if markers is None else len(markers)
    if numbers is None:
        return np.zeros((0, 3)), np.zeros((0, 2)), count
    places = np.asarray(board.getChessboardCorners(), float)[numbers.ravel()]
    # OpenCV's y is down; unlike its other functions, this one counts from the first pixel's edge
    return places * [1, -1, 1], pixels.reshape(-1, 2).astype(float), count
