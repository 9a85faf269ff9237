"""Pictures of a world: discs on a light ground, without a graphics library."""

from __future__ import annotations

import numpy as np

GROUND, FRAME = (250, 250, 248), (216, 216, 212)
LANDMARK, BALL, AGENT, CRASHED = (222, 143, 5), (120, 120, 120), (1, 115, 178), (160, 60, 60)
#: Width of the picture over the side of the map: agents may leave the map.
ROOM = 1.25
#: Radii in world units.
PARTICLE, BALL_RADIUS, DRONE = 0.1, 0.15, 0.06


def disc(picture: np.ndarray, x: float, y: float, radius: float, colour: tuple[int, int, int]) -> None:
    """Draws a disc, in pixels, with a soft edge of one pixel; what is outside of the picture is cut."""
    height, width, _ = picture.shape
    # Far outside, or not finite.
    if not (-radius - 1 < x < width + radius + 1 and -radius - 1 < y < height + radius + 1):
        return
    left, right = max(int(x - radius - 1), 0), min(int(x + radius + 2), width)
    top, bottom = max(int(y - radius - 1), 0), min(int(y + radius + 2), height)
    columns, rows = np.arange(left, right) + 0.5 - x, np.arange(top, bottom) + 0.5 - y
    distance = np.sqrt(columns[None] ** 2 + rows[:, None] ** 2)
    cover = np.clip(radius + 0.5 - distance, 0.0, 1.0)[:, :, None]
    part = picture[top:bottom, left:right]
    part[:] = np.rint(part + cover * (np.asarray(colour, np.float64) - part)).astype(np.uint8)


def picture(
    positions: np.ndarray, landmarks: np.ndarray, agents: int, out: np.ndarray, side: float, mark: float, size: int
) -> np.ndarray:
    """[size, size, 3] uint8 of a world as seen from above, x to the right and y up.

    positions: [E, D] agents, then balls. landmarks: [N, D]. out: bool [N] for drones that crashed.
    side: of the map. mark: radius of a landmark. Lengths are world units.
    """
    image = np.empty((size, size, 3), np.uint8)
    image[:] = GROUND
    scale = size / (side * ROOM)
    edge = round(size * (1 - 1 / ROOM) / 2)
    image[edge, edge:-edge] = image[-edge - 1, edge:-edge] = FRAME
    image[edge:-edge, edge] = image[edge:-edge, -edge - 1] = FRAME

    def draw(point: np.ndarray, radius: float, colour: tuple[int, int, int]) -> None:
        x, y = size / 2 + float(point[0]) * scale, size / 2 - float(point[1]) * scale
        disc(image, x, y, max(radius * scale, 1.5), colour)

    for point in landmarks:
        draw(point, mark, LANDMARK)
    for point in positions[agents:]:
        draw(point, BALL_RADIUS, BALL)
    flies = positions.shape[1] == 3
    for point, crashed in zip(positions[:agents], out):
        draw(point, DRONE if flies else PARTICLE, CRASHED if crashed else AGENT)
    return image
