"""Lenses by any function of the angle from the axis, for tests and benchmarks: nothing of `StarCamera`."""

import numpy as np
from scipy.optimize import brentq, least_squares
from scipy.spatial.transform import Rotation

SIZE = WIDTH, HEIGHT = 2048, 1536


class ForeignLens:
    """In place of `StarCamera` where stars are listed: `radius` is that of the image of an angle over the
    focal length, `shift` displaces the image, px."""

    width_px, height_px = SIZE

    def __init__(self, fov_deg, radius, shift=lambda x, y: (0.0 * x, 0.0 * y)):
        self.radius, self.shift = radius, shift
        self.field_radius_rad = np.radians(0.75 * fov_deg)
        self.focal_px = 0.5 * WIDTH / radius(np.radians(0.5 * fov_deg))

    def pixels_from_directions(self, u_s):
        off = np.hypot(u_s[:, 0], u_s[:, 1])
        r = self.focal_px * self.radius(np.arctan2(off, u_s[:, 2])) / np.maximum(off, 1e-15)
        x, y = 1030.8 - r * u_s[:, 0], 762.4 - r * u_s[:, 1]
        dx, dy = self.shift(x / WIDTH - 0.5, y / WIDTH - 0.375)
        return np.column_stack([x + dx, y + dy])

    def contains(self, xy_px):
        return ((xy_px > -0.5) & (xy_px < np.array(SIZE) - 0.5)).all(axis=1)

    def direction_from_pixel(self, xy_px):
        """(3,) of a pixel (2,), for a lens without `shift`."""
        x, y = 1030.8 - xy_px[0], 762.4 - xy_px[1]
        r = np.hypot(x, y)
        theta = brentq(lambda angle: self.focal_px * self.radius(angle) - r, 0.0, 1.5, xtol=1e-15)
        return np.array([np.sin(theta) * x / r, np.sin(theta) * y / r, np.cos(theta)])

    @property
    def fov_x_rad(self):
        """Angle between the middles of the left and right edges."""
        row = 0.5 * (HEIGHT - 1)
        left, right = (self.direction_from_pixel((x, row)) for x in (-0.5, WIDTH - 0.5))
        return 2.0 * np.arcsin(0.5 * np.linalg.norm(right - left))

    def error_px(self, camera, xy_px):
        """(N, 2) px, of the directions that a camera has for pixels (N, 2), the best rotation taken out."""
        u_s = camera.directions_from_pixels(xy_px)

        def error(turn):
            turned = Rotation.from_rotvec(1e-3 * turn).apply(u_s)
            return (self.pixels_from_directions(turned) - xy_px).ravel()

        return error(least_squares(error, np.zeros(3)).x).reshape(-1, 2)
