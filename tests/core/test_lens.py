from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from bask_data.core.geometry import in_image, pixel_grid, project, unproject
from bask_data.core.lens import MODELS, Distortion, Lens, undistorted, undistortion

HEIGHT, WIDTH = 240, 320
K = np.array([[262.0, 0, 163.2], [0, 255.0, 117.4], [0, 0, 1]])
SQUARE = 0.1
WINDOW = 7  # Half of what the corner finder looks at, pixels: with less its own error is above 0.1 in a pinhole image.
MARGIN = WINDOW + 4
CAMERA_FROM_BOARD = np.eye(4)
CAMERA_FROM_BOARD[:3, :3] = cv2.Rodrigues(np.array([0.25, -0.2, 0.1]))[0]
CAMERA_FROM_BOARD[:3, 3] = [0.02, -0.03, 0.85]

Coordinates = tuple[np.ndarray, np.ndarray]


# The published formulas, each from the normalised coordinates of a ray to the distorted ones --------------------------


def brown(x: np.ndarray, y: np.ndarray, *given: float) -> Coordinates:
    """OpenCV, calib3d: rational radial, tangential and thin prism terms."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = (*given, *[0.0] * (12 - len(given)))
    r2 = x * x + y * y
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + s1 * r2 + s2 * r2**2,
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + s3 * r2 + s4 * r2**2,
    )


def tilted(x: np.ndarray, y: np.ndarray, *given: float) -> Coordinates:
    """OpenCV, calib3d: the sensor turned by tau_x and tau_y (the Scheimpflug condition)."""
    x, y = brown(x, y, *given[:12])
    (cx, cy), (sx, sy) = np.cos(given[12:]), np.sin(given[12:])
    turn = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    to_sensor = np.array([[turn[2, 2], 0, -turn[0, 2]], [0, turn[2, 2], -turn[1, 2]], [0, 0, 1]]) @ turn
    a, b, c = np.einsum("ij,jn->in", to_sensor, np.stack([x, y, np.ones_like(x)]))
    return a / c, b / c


def radial(x: np.ndarray, y: np.ndarray, *k: float) -> Coordinates:
    """COLMAP, sensor/models.h: a polynomial in r^2."""
    r2 = x * x + y * y
    factor = 1 + sum(k_i * r2 ** (i + 1) for i, k_i in enumerate(k))
    return x * factor, y * factor


def by_angle(x: np.ndarray, y: np.ndarray) -> Coordinates:
    """The equidistant projection: the distance from the centre is the angle to the optical axis."""
    r = np.hypot(x, y)
    factor = np.where(r > 1e-12, np.arctan(r) / np.maximum(r, 1e-12), 1.0)
    return x * factor, y * factor


def fisheye(x: np.ndarray, y: np.ndarray, *k: float) -> Coordinates:
    """Kannala and Brandt 2006, as in OpenCV's fisheye: theta (1 + k1 theta^2 + ...)."""
    return radial(*by_angle(x, y), *k)


def fov(x: np.ndarray, y: np.ndarray, omega: float) -> Coordinates:
    """Devernay and Faugeras 2001: r' = atan(2 r tan(omega / 2)) / omega."""
    r = np.maximum(np.hypot(x, y), 1e-12)
    factor = np.arctan(2 * r * np.tan(omega / 2)) / (omega * r)
    return x * factor, y * factor


def division(x: np.ndarray, y: np.ndarray, k: float) -> Coordinates:
    """Fitzgibbon 2001: r = r' / (1 + k r'^2), solved for r'."""
    r2 = x * x + y * y
    factor = 2 / (1 + np.sqrt(1 - 4 * k * r2))
    return x * factor, y * factor


def eucm(x: np.ndarray, y: np.ndarray, alpha: float, beta: float) -> Coordinates:
    """Khomutenko et al. 2016, the enhanced unified camera model."""
    below = alpha * np.sqrt(beta * (x * x + y * y) + 1) + 1 - alpha
    return x / below, y / below


def thin_prism_fisheye(x: np.ndarray, y: np.ndarray, *given: float) -> Coordinates:
    """ETH3D's model, in COLMAP's order k1 k2 p1 p2 k3 k4 sx1 sy1."""
    k1, k2, p1, p2, k3, k4, sx, sy = given
    x, y = by_angle(x, y)
    r2 = x * x + y * y
    factor = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    return (
        x * factor + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + sx * r2,
        y * factor + 2 * p2 * x * y + p1 * (r2 + 2 * y * y) + sy * r2,
    )


def fisheye624(x: np.ndarray, y: np.ndarray, *given: float) -> Coordinates:
    """Project Aria's model: tangential and thin prism terms follow the radial ones."""
    p0, p1, s0, s1, s2, s3 = given[6:]
    x, y = fisheye(x, y, *given[:6])
    r2 = x * x + y * y
    return (
        x + p0 * (r2 + 2 * x * x) + 2 * p1 * x * y + s0 * r2 + s1 * r2**2,
        y + p1 * (r2 + 2 * y * y) + 2 * p0 * x * y + s2 * r2 + s3 * r2**2,
    )


LENSES: dict[str, tuple[Distortion, Callable[..., Coordinates]]] = {
    f"{distortion.model} {len(distortion.parameters)}": (distortion, formula)
    for distortion, formula in (
        (Distortion("OPENCV", (-0.28, 0.09, 0.003, -0.004)), brown),
        (Distortion("plumb_bob", (0.16, -0.2, 0.002, 0.005, 0.05)), brown),
        (Distortion("OPENCV", (0.9, 0.3, 0.001, -0.002, 0.02, 1.2, 0.5, 0.05)), brown),
        (Distortion("OPENCV", (-0.2, 0.05, 0.001, 0.002, 0.0, 0.1, 0.0, 0.0, 0.01, -0.004, -0.006, 0.002)), brown),
        (
            Distortion("OPENCV", (-0.2, 0.05, 0.001, 0.002, 0.0, 0.1, 0.0, 0.0, 0.01, 0.0, 0.0, 0.002, 0.03, -0.02)),
            tilted,
        ),
        (Distortion("FULL_OPENCV", (-0.2, 0.05, 0.003, -0.002, 0.01, 0.1, 0.02, 0.01)), brown),
        (Distortion("OPENCV_FISHEYE", (-0.02, 0.03, -0.01, 0.004)), fisheye),
        (Distortion("SIMPLE_RADIAL", (-0.15,)), radial),
        (Distortion("RADIAL", (-0.2, 0.06)), radial),
        (Distortion("FOV", (0.9,)), fov),
        (Distortion("SIMPLE_DIVISION", (-0.2,)), division),
        (Distortion("DIVISION", (0.15,)), division),
        (Distortion("EUCM", (0.6, 1.1)), eucm),
        (Distortion("SIMPLE_FISHEYE", ()), fisheye),
        (Distortion("FISHEYE", ()), fisheye),
        (Distortion("SIMPLE_RADIAL_FISHEYE", (0.04,)), fisheye),
        (Distortion("RADIAL_FISHEYE", (0.05, -0.02)), fisheye),
        (
            Distortion("THIN_PRISM_FISHEYE", (-0.02, 0.03, 0.002, -0.003, 0.01, -0.005, 0.004, -0.003)),
            thin_prism_fisheye,
        ),
        (
            Distortion(
                "RAD_TAN_THIN_PRISM_FISHEYE",
                (-0.02, 0.09, -0.05, 0.003, 0.005, -0.001, 0.002, -0.003, 0.004, -0.001, -0.003, 0.0007),
            ),
            fisheye624,
        ),
    )
}


def test_every_model_has_a_lens_here() -> None:
    tried = {(distortion.name, len(distortion.parameters)) for distortion, _ in LENSES.values()}
    assert tried == {(name, n) for name, counts in MODELS.items() for n in counts if "PINHOLE" not in name}


# A checkerboard through each of them ----------------------------------------------------------------------------------


def board(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colour and z-depth of a checkerboard at normalised coordinates. Its edges are one or two pixels soft, as a lens
    makes them."""
    normal, point = CAMERA_FROM_BOARD[:3, 2], CAMERA_FROM_BOARD[:3, 3]
    z = normal @ point / (normal[0] * x + normal[1] * y + normal[2])
    on_board = (np.stack([x * z, y * z, z], axis=-1) - point) @ CAMERA_FROM_BOARD[:3, :2]
    wave = np.prod(np.sin(np.pi * on_board / SQUARE), axis=-1)
    return np.repeat((127.5 + 110 * np.tanh(10 * wave)).astype(np.uint8)[..., None], 3, axis=-1), z.astype(np.float32)


def inverse(
    formula: Callable[..., Coordinates], parameters: tuple[float, ...], x: np.ndarray, y: np.ndarray
) -> Coordinates:
    """The rays that a lens takes to the given distorted coordinates, by Newton's method; NaN where there is none."""
    a, b = x.copy(), y.copy()
    step = 1e-6
    with np.errstate(all="ignore"):
        for _ in range(25):
            at_x, at_y = formula(a, b, *parameters)
            (xa, ya), (xb, yb) = formula(a + step, b, *parameters), formula(a, b + step, *parameters)
            j = (xa - at_x) / step, (xb - at_x) / step, (ya - at_y) / step, (yb - at_y) / step
            determinant = j[0] * j[3] - j[1] * j[2]
            a, b = (
                a - (j[3] * (at_x - x) - j[1] * (at_y - y)) / determinant,
                b - (j[0] * (at_y - y) - j[2] * (at_x - x)) / determinant,
            )
        at_x, at_y = formula(a, b, *parameters)
        solved = np.hypot(at_x - x, at_y - y) < 1e-9
    return np.where(solved, a, np.nan), np.where(solved, b, np.nan)


def rays(uv: np.ndarray, K: np.ndarray) -> Coordinates:
    xyz = unproject(uv, np.ones(uv.shape[:-1]), K).reshape(-1, 3)
    return xyz[:, 0], xyz[:, 1]


def photograph(distortion: Distortion, formula: Callable[..., Coordinates]) -> tuple[np.ndarray, np.ndarray]:
    """Colour and depth as a camera with this lens takes them."""
    x, y = inverse(formula, distortion.parameters, *rays(pixel_grid(HEIGHT, WIDTH), K))
    colour, depth = board(x, y)
    return colour.reshape(HEIGHT, WIDTH, 3), np.nan_to_num(depth).reshape(HEIGHT, WIDTH)


def corners(margin: float) -> np.ndarray:
    """Where a pinhole camera sees the corners of the squares, away from the image's border."""
    i, j = np.meshgrid(np.arange(-9, 10), np.arange(-9, 10))
    on_board = np.stack([i.ravel() * SQUARE, j.ravel() * SQUARE, np.zeros(i.size)], axis=-1)
    uv, z = project(on_board @ CAMERA_FROM_BOARD[:3, :3].T + CAMERA_FROM_BOARD[:3, 3], K)
    in_view = (z > 0) & (uv >= margin).all(axis=1) & (uv <= np.array([WIDTH, HEIGHT]) - 1 - margin).all(axis=1)
    return uv[in_view]


@pytest.mark.parametrize("name", LENSES)
def test_maps_follow_the_published_formula(name: str) -> None:
    distortion, formula = LENSES[name]
    maps = undistortion(Lens(K, (HEIGHT, WIDTH), distortion))
    assert maps is not None
    x, y = formula(*rays(pixel_grid(HEIGHT, WIDTH), K), *distortion.parameters)
    uv, _ = project(np.stack([x, y, np.ones_like(x)], axis=-1), K)
    assert np.abs(np.stack([maps.u, maps.v], axis=-1).reshape(-1, 2) - uv)[maps.inside.ravel()].max() < 1e-4
    assert np.array_equal(maps.inside.ravel(), in_image(uv, HEIGHT, WIDTH))


@pytest.mark.parametrize("name", LENSES)
def test_corners_of_an_undistorted_checkerboard_are_where_a_pinhole_camera_sees_them(name: str) -> None:
    distortion, formula = LENSES[name]
    colour, depth = photograph(distortion, formula)
    maps = undistortion(Lens(K, (HEIGHT, WIDTH), distortion))
    assert maps is not None
    expected = corners(MARGIN)
    u, v = np.rint(expected).astype(int).T
    near = np.array(
        [
            maps.inside[v_i - MARGIN : v_i + MARGIN + 1, u_i - MARGIN : u_i + MARGIN + 1].all()
            for u_i, v_i in zip(u, v, strict=True)
        ]
    )
    expected = expected[near]
    assert len(expected) > 40
    assert np.hypot(maps.u[v, u] - u, maps.v[v, u] - v)[near].max() > 3, "a lens that proves nothing"

    grey = undistorted(colour, maps)[..., 0]
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
    start = (expected + 0.5).astype(np.float32, order="C").reshape(-1, 1, 2)
    found = cv2.cornerSubPix(np.ascontiguousarray(grey), start, (WINDOW, WINDOW), (-1, -1), criteria)[:, 0]
    assert np.linalg.norm(found - expected, axis=1).max() < 0.1

    of_pinhole = board(*rays(pixel_grid(HEIGHT, WIDTH), K))[1].reshape(HEIGHT, WIDTH)
    flat = undistorted(depth, maps)
    # The nearest pixel is at most 0.71 pixels away, and the board's depth changes by 0.2 % per pixel.
    assert np.abs(flat / of_pinhole - 1)[maps.inside].max() < 0.003
    assert (flat[~maps.inside] == 0).all() and (grey[~maps.inside] == 0).all()


def test_a_lens_with_skew_is_undistorted_with_its_skew() -> None:
    skewed = K + np.array([[0, 9.0, 0], [0, 0, 0], [0, 0, 0]])
    distortion, formula = LENSES["RADIAL 2"]
    for model in ("RADIAL", "OPENCV"):
        parameters = distortion.parameters if model == "RADIAL" else (*distortion.parameters, 0.0, 0.0)
        maps = undistortion(Lens(skewed, (HEIGHT, WIDTH), Distortion(model, parameters)))
        assert maps is not None
        x, y = formula(*rays(np.array([[300.0, 20.0]]), skewed), *distortion.parameters)
        (expected,), _ = project(np.stack([x, y, np.ones(1)], axis=-1), skewed)
        assert (maps.u[20, 300], maps.v[20, 300]) == pytest.approx(expected, abs=1e-3)


# What is left alone, kept and refused ---------------------------------------------------------------------------------


def test_zero_parameters_of_a_perspective_lens_leave_the_image_as_it_is_and_of_a_fisheye_do_not() -> None:
    image = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    for distortion in (None, Distortion("PINHOLE", ()), Distortion("OPENCV", (0.0,) * 5), Distortion("FOV", (0.0,))):
        maps = undistortion(Lens(K, (HEIGHT, WIDTH), distortion))
        assert maps is None
        assert undistorted(image, maps) is image
    assert undistortion(Lens(K, (HEIGHT, WIDTH), Distortion("OPENCV_FISHEYE", (0.0,) * 4))) is not None


def test_maps_are_shared_by_equal_lenses_and_differ_with_each_frames_K() -> None:
    moving = np.stack([K, K + np.array([[0, 0, 2.0], [0, 0, 0], [0, 0, 0]]), K])
    lens = Lens(moving, (HEIGHT, WIDTH), Distortion("RADIAL", (-0.1, 0.0)))
    first, second, third = (undistortion(lens.at(i)) for i in range(3))
    assert first is third
    assert first is not None and second is not None
    assert not np.array_equal(first.u, second.u)
    assert not first.u.flags.writeable
    with pytest.raises(ValueError, match="expected one matrix"):
        undistortion(lens)


def test_labels_stay_labels_and_colours_reach_the_border() -> None:
    maps = undistortion(Lens(K, (HEIGHT, WIDTH), Distortion("RADIAL", (0.1, 0.0))))
    assert maps is not None
    labels = np.where(np.arange(WIDTH) < 150, 3, 200).astype(np.uint8) * np.ones((HEIGHT, 1), np.uint8)
    assert set(np.unique(undistorted(labels, maps))) == {0, 3, 200}
    white = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    assert np.array_equal(undistorted(white, maps)[..., 0] == 255, maps.inside)
    with pytest.raises(ValueError, match=r"expected the size of the lens, \(240, 320\), got \(240, 319\)"):
        undistorted(white[:, 1:], maps)


@pytest.mark.parametrize(
    ("model", "parameters", "message"),
    [
        ("KANNALA", (0.1,), "lens model 'KANNALA': expected one of PINHOLE, .*EUCM"),
        ("EQUIRECTANGULAR", (), "lens model 'EQUIRECTANGULAR': expected one of"),
        ("OPENCV", (0.1, 0.1, 0.1), "lens model OPENCV: expected 4 or 5 or 8 or 12 or 14 parameters, got 3"),
        ("RADIAL", (0.1, float("nan")), r"lens model RADIAL: expected finite parameters, got \[0.1, nan\]"),
    ],
)
def test_models_that_nobody_knows_and_parameters_that_do_not_fit_are_refused_by_name(
    model: str, parameters: tuple[float, ...], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        Distortion(model, parameters)


@pytest.mark.parametrize(
    "distortion",
    [
        Distortion("OPENCV", (-0.9, 0.1, 0.0, 0.0)),  # turns back inside the image
        Distortion("SIMPLE_RADIAL", (-3.0,)),  # all the way to the other side
        Distortion("OPENCV", (0.0, 0.0, 0.0, 0.0, 0.0, -8.0, 0.0, 0.0)),  # through a pole
    ],
)
def test_a_distortion_that_folds_the_image_over_is_refused(distortion: Distortion) -> None:
    with pytest.raises(ValueError, match=f"lens model {distortion.model}, parameters .*folded over at"):
        undistortion(Lens(K, (HEIGHT, WIDTH), distortion))


def test_a_polynomial_that_turns_back_beyond_the_image_is_no_fold() -> None:
    # r (1 + 2 r^2 - 2 r^4) turns back at r = 0.86, where it is far outside, and comes back to 0 at r = 1.16.
    wide = np.array([[210.0, 0, 159.5], [0, 210.0, 119.5], [0, 0, 1]])
    maps = undistortion(Lens(wide, (HEIGHT, WIDTH), Distortion("RADIAL", (2.0, -2.0))))
    assert maps is not None
    r = np.linalg.norm(pixel_grid(HEIGHT, WIDTH) - [159.5, 119.5], axis=-1) / 210
    assert r.max() > 0.9
    assert r[maps.inside].max() < 0.8
