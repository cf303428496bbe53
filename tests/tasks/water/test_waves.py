"""The sea has the height, period, speed and directions that were asked of it."""

import math

import numpy as np
import pytest

from gdrl_tasks.water import waves
from gdrl_tasks.water.definition import elevation, wave_phase
from gdrl_tasks.water.hull import make_hull
from gdrl_tasks.water.options import WaterOptions
from gdrl_tasks.water.task import WaterTask
from tests.oracles.waves import energy_period, orbital_velocity

GRAVITY = 9.81


def draw(seed=0, **changes):
    settings = {
        "height_m": 0.2,
        "period_s": 1.5,
        "direction_rad": 0.7,
        "num_components": 12,
        "shortest_wave_m": 0.3,
        "depth_m": 0.04,
    }
    return waves.draw_sea(np.random.default_rng(seed), **(settings | changes))


def batched(sea):
    return {name: value[None] for name, value in sea.items()}


def episodes(options, seeds):
    """Seas of many episodes as arrays ``[W, C]``, with their heights and periods."""
    task = WaterTask(options)
    drawn = [task.draw_episode(seed).arrays for seed in seeds]
    sea = {name: np.stack([a[name] for a in drawn]) for name in waves.SEA_FIELDS}
    heights = np.array([a["significant_wave_height"] for a in drawn])
    return sea, heights, np.array([a["peak_period"] for a in drawn])


def spectral_moments(series, interval_s):
    """m0 and m-1 of records ``[..., T]`` from windowed periodograms."""
    window = np.hanning(series.shape[-1])
    power = np.abs(np.fft.rfft(series * window, axis=-1)) ** 2
    frequency = np.fft.rfftfreq(series.shape[-1], interval_s)
    keep = frequency > 0.003 / interval_s
    scale = (window**2).sum() * series.shape[-1] / 2.0
    power, frequency = power[..., keep] / scale, frequency[keep]
    return power.sum(axis=-1), (power / frequency).sum(axis=-1)


@pytest.mark.parametrize(
    "options",
    [
        WaterOptions(sea="lake"),
        WaterOptions(sea="rough"),
        WaterOptions(significant_wave_height_m=0.3, peak_period_s=4.0, wave_components=40),
        # The edges of the range: shortest, highest and steepest, longest, fewest.
        WaterOptions(significant_wave_height_m=0.04, peak_period_s=0.62),
        WaterOptions(
            significant_wave_height_m=0.04, peak_period_s=0.62, wave_components=60
        ),
        WaterOptions(significant_wave_height_m=2.0, peak_period_s=4.39),
        WaterOptions(significant_wave_height_m=2.0, peak_period_s=30.0),
        WaterOptions(significant_wave_height_m=0.1, peak_period_s=1.0, wave_components=1),
    ],
    ids=["lake", "rough", "swell", "short", "short-60", "high", "long", "regular"],
)
@pytest.mark.parametrize("seas", [5, pytest.param(20, marks=pytest.mark.full)])
def test_height_and_energy_period_are_those_requested(options, seas):
    sea, heights, periods = episodes(options, seeds=range(seas))
    places = np.array([[0.0, 0.0], [3.0, 1.0], [-5.0, 2.0], [0.4, -7.0], [11.0, 13.0]])
    x, y = (np.tile(places[:, i], (seas, 1)) for i in range(2))
    # Long enough for neighbouring frequencies to go in and out of step many times.
    interval = 0.15 * max(1.0, periods.max() / 2.0)
    times = interval * np.arange(12_000)
    record = np.stack([elevation(sea, x, y, np.full(seas, t)) for t in times], axis=-1)
    wanted_height = np.broadcast_to(heights[:, None], (seas, 5))
    np.testing.assert_allclose(4.0 * record.std(axis=-1), wanted_height, rtol=0.05)
    zeroth, minus_first = spectral_moments(record, interval)
    np.testing.assert_allclose(4.0 * np.sqrt(zeroth), wanted_height, rtol=0.05)
    wanted_period = [[energy_period(period)] * 5 for period in periods]
    np.testing.assert_allclose(minus_first / zeroth, wanted_period, rtol=0.05)


def test_the_spectrum_has_its_height_and_its_peak():
    omega = np.linspace(0.5, 200.0, 400_000)
    density = waves.jonswap(omega, 0.3, 2.0)
    assert 4.0 * math.sqrt(np.trapezoid(density, omega)) == pytest.approx(0.3, rel=0.01)
    assert omega[density.argmax()] == pytest.approx(math.pi, rel=1e-3)


@pytest.mark.parametrize("period", [0.62, 0.7, 1.5, 5.0])
def test_deep_water_dispersion(period):
    sea = draw(period_s=period)
    wavenumber = np.hypot(sea["wavenumber_x"], sea["wavenumber_y"])
    np.testing.assert_allclose(sea["omega"] ** 2, GRAVITY * wavenumber, rtol=1e-12)


@pytest.mark.parametrize("period", [0.62, 0.7, 1.5, 5.0])
@pytest.mark.parametrize("components", [1, 12, 200])
def test_no_wave_is_shorter_than_two_spacings_of_the_hull_points(period, components):
    shortest = 2.0 * make_hull().spacing_m
    sea = draw(period_s=period, num_components=components, shortest_wave_m=shortest)
    wavenumber = np.hypot(sea["wavenumber_x"], sea["wavenumber_y"])
    assert (2.0 * math.pi / wavenumber).min() >= shortest * (1.0 - 1e-12)


def test_components_are_waves_that_travel_in_their_direction():
    sea = batched(draw(num_components=1))
    direction = np.arctan2(sea["wavenumber_y"], sea["wavenumber_x"])[0, 0]
    speed = GRAVITY / sea["omega"][0, 0]
    at = np.array([[0.3]]), np.array([[-0.2]])
    later = at[0] + speed * math.cos(direction), at[1] + speed * math.sin(direction)
    start = elevation(sea, *at, np.array([2.0]))
    assert elevation(sea, *later, np.array([3.0])) == pytest.approx(start, abs=1e-12)


def potential(sea, x, y, z, time_s):
    """Velocity potential of linear deep-water waves, z from the still surface."""
    phase = wave_phase(sea, x, y, time_s)
    wavenumber = np.hypot(sea["wavenumber_x"], sea["wavenumber_y"])[:, None]
    depth = np.exp(wavenumber * z[..., None])
    scale = (sea["amplitude"] * GRAVITY / sea["omega"])[:, None]
    return (scale * depth * np.sin(phase)).sum(axis=-1)


def test_orbital_velocity_is_the_potentials_gradient_hung_from_the_surface():
    sea = batched(draw())
    generator = np.random.default_rng(1)
    x, y = generator.uniform(-5.0, 5.0, (2, 1, 50))
    time = np.array([3.7])
    surface = elevation(sea, x, y, time)
    depth = generator.uniform(0.0, 1.0, surface.shape)
    depth[:, 0] = 0.0
    velocity = orbital_velocity(sea, x, y, surface - depth, time)
    step = 1e-5
    gradient = [
        (
            potential(sea, x + dx, y + dy, dz - depth, time)
            - potential(sea, x - dx, y - dy, -dz - depth, time)
        )
        / (2.0 * step)
        for dx, dy, dz in step * np.eye(3)
    ]
    np.testing.assert_allclose(velocity, np.stack(gradient, axis=-1), atol=1e-8)


def test_water_at_the_surface_moves_as_linear_theory_says_at_still_water():
    sea = batched(draw())
    x, y, time = np.array([[0.3, 2.0]]), np.array([[1.0, -4.0]]), np.array([5.0])
    surface = elevation(sea, x, y, time)
    velocity = orbital_velocity(sea, x, y, surface, time)
    phase = wave_phase(sea, x, y, time)
    speed = (sea["amplitude"] * sea["omega"])[:, None]
    wavenumber = np.hypot(sea["wavenumber_x"], sea["wavenumber_y"])
    ahead = (speed * np.cos(phase) * (sea["wavenumber_x"] / wavenumber)[:, None]).sum(-1)
    np.testing.assert_allclose(velocity[..., 0], ahead, rtol=1e-12)
    # The surface rises with the water in it, and water above it counts as in it.
    step = 1e-5
    rise = elevation(sea, x, y, time + step) - elevation(sea, x, y, time - step)
    np.testing.assert_allclose(velocity[..., 2], rise / (2.0 * step), atol=1e-8)
    above = orbital_velocity(sea, x, y, surface + 1.0, time)
    np.testing.assert_array_equal(above, velocity)


def test_orbital_velocity_fades_with_depth():
    sea = batched(draw(num_components=1, period_s=1.2))
    zero = np.zeros((1, 1))
    surface = elevation(sea, zero, zero, np.zeros(1))
    top, deep = (
        orbital_velocity(sea, zero, zero, surface - depth, np.zeros(1))
        for depth in (0.0, 0.5)
    )
    wavenumber = sea["omega"][0, 0] ** 2 / GRAVITY
    np.testing.assert_allclose(deep, top * math.exp(-0.5 * wavenumber), rtol=1e-12)


def test_directions_spread_around_the_mean():
    sea = draw(num_components=20_000, direction_rad=2.5)
    heading = np.arctan2(sea["wavenumber_y"], sea["wavenumber_x"])
    offset = (heading - 2.5 + math.pi) % (2.0 * math.pi) - math.pi
    assert np.abs(offset).max() <= 0.5 * math.pi
    assert offset.mean() == pytest.approx(0.0, abs=0.02)
    # Of the density 2/pi cos^2.
    assert offset.var() == pytest.approx(math.pi**2 / 12.0 - 0.5, rel=0.03)
    assert np.unique(heading).size == heading.size


@pytest.mark.parametrize("components", [2, 12, 200, 1000])
@pytest.mark.parametrize("period", [0.62, 0.714, 1.5, 30.0])
def test_no_two_components_share_a_frequency(period, components):
    omega = draw(period_s=period, num_components=components)["omega"]
    assert np.unique(omega).size == components
    # And together they have the energy period of the whole spectrum.
    mean_period = (2.0 * math.pi / omega).mean()
    assert mean_period == pytest.approx(energy_period(period), rel=1e-6)


def test_a_sea_is_refused_that_the_hull_points_do_not_resolve():
    assert waves.SHORTEST_PERIOD_S == 0.62
    draw(period_s=waves.SHORTEST_PERIOD_S)
    with pytest.raises(ValueError, match=r"period_s=0\.61: only 7\d% .* 75% is needed"):
        draw(period_s=0.61)
    with pytest.raises(ValueError, match=r"period_s=0\.4"):
        draw(period_s=0.4)
    draw(period_s=0.4, shortest_wave_m=0.1)


@pytest.mark.parametrize("sea", ["lake", "rough"])
def test_no_sea_of_a_preset_is_too_steep_or_outside_the_range(sea):
    _, heights, periods = episodes(WaterOptions(sea=sea), seeds=range(300))
    length = GRAVITY * periods**2 / (2.0 * math.pi)
    assert (heights / length).max() < 1.0 / 15.0
    (low, high), (short, long) = waves.sea_range(sea)
    assert low <= heights.min()
    assert heights.max() <= high
    assert waves.SHORTEST_PERIOD_S <= short <= periods.min()
    assert periods.max() <= long <= waves.LONGEST_PERIOD_S


@pytest.mark.parametrize(
    ("wind", "fetch", "height", "period", "wavelength"),
    [
        (3.0, 500.0, 0.034, 0.71, 0.80),
        (5.0, 500.0, 0.057, 0.85, 1.12),
        (5.0, 2000.0, 0.114, 1.34, 2.8),
        (8.0, 2000.0, 0.183, 1.57, 3.9),
    ],
)
def test_fetch_limited_lakes(wind, fetch, height, period, wavelength):
    drawn_height, drawn_period = waves.fetch_limited_sea(wind, fetch)
    assert drawn_height == pytest.approx(height, abs=6e-4)
    assert drawn_period == pytest.approx(period, abs=6e-3)
    drawn_wavelength = GRAVITY * drawn_period**2 / (2.0 * math.pi)
    assert drawn_wavelength == pytest.approx(wavelength, rel=0.02)


@pytest.mark.parametrize("sea", ["lake", "rough"])
def test_episodes_stay_inside_the_preset(sea):
    preset = waves.SEAS[sea]
    _, heights, periods = episodes(WaterOptions(sea=sea), seeds=range(200))
    least = waves.fetch_limited_sea(preset.wind_m_s[0], preset.fetch_m[0])
    most = waves.fetch_limited_sea(preset.wind_m_s[1], preset.fetch_m[1])
    assert least[0] <= heights.min() < 1.3 * least[0]
    assert 0.8 * most[0] < heights.max() <= most[0]
    assert least[1] <= periods.min()
    assert periods.max() <= most[1]


def test_a_sea_without_height_is_flat():
    sea = batched(draw(height_m=0.0))
    x, y = np.linspace(-3.0, 3.0, 14).reshape(2, 1, 7)
    time = np.array([1.0])
    assert (elevation(sea, x, y, time) == 0.0).all()
    assert (orbital_velocity(sea, x, y, -0.1 * np.ones_like(x), time) == 0.0).all()


def test_calm_episodes_are_flat():
    sea, heights, _ = episodes(WaterOptions(sea="calm"), seeds=range(3))
    assert (heights == 0.0).all()
    assert (sea["amplitude"] == 0.0).all()


def test_torch_and_numpy_give_the_same_surface():
    torch = pytest.importorskip("torch")
    sea = batched(draw())
    x, y, time = np.array([[0.3, 2.0]]), np.array([[1.0, -4.0]]), np.array([5.0])
    tensors = {name: torch.from_numpy(value) for name, value in sea.items()}
    points = [torch.from_numpy(value) for value in (x, y, time)]
    np.testing.assert_allclose(
        elevation(tensors, *points), elevation(sea, x, y, time), rtol=1e-12
    )
