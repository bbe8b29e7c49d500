"""The reproduction of the 2002 paper, and its figures on small data."""

import types

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure

from jaxguide import plotting, reproduce
from jaxguide.problems.earth_mars import EarthMars
from jaxguide.reproduce.earth_mars import collocation
from jaxguide.reproduce.earth_mars.published import STATES, UNITS
from jaxguide.spectral import differentiation_matrix, nodes_lgl

SEGMENTS, P = 3, 5


class Recorder:
    """A progress object that remembers."""

    def __init__(self):
        self.seen, self.closed = [], 0

    def init(self):
        return 0

    def step(self, state, progress):
        self.seen.append(progress)
        return state + 1

    def close(self, state):
        self.closed += 1


@pytest.mark.slow
def test_paper(tmp_path):
    progress = Recorder()
    report = reproduce.get("earth-mars").run(tmp_path, progress)
    failed = [(s.title, row.name) for s in report.sections for row in s.rows if not row.passed]
    assert failed == []
    assert report.passed
    assert sum(row.judged for row in report.rows) > 90
    assert progress.closed == 1
    assert progress.seen == sorted(progress.seen) and progress.seen[-1] == pytest.approx(1.0)
    names = {path.name for path in tmp_path.glob("*.png")}
    assert len(names) == len(report.figures) == 8
    assert [name for name in sorted(names) if "fig" in name] == [
        f"earth-mars-{figure}.png"
        for figure in ("fig2-nominal", "fig3-feedback", "fig4-to-6-states", "fig7-to-9-reoptimised")
    ]
    wrong = next(s for s in report.sections if "wrong" in s.title)
    assert wrong.rows[-1].computed >= 7  # most of the printed r and v_t, of 12


def extremal():
    """A straight-line stand-in with the mesh of a real one."""
    tau, _ = nodes_lgl(P)
    breaks = np.array([0.0, 1.0, 1.5, 3.32])
    inner = breaks[:-1, None] + np.diff(breaks)[:, None] * (tau[None, :-1] + 1) / 2
    t = np.append(inner.reshape(-1), breaks[-1])
    x = np.stack([1 + t**2 / 20, 0.1 * t, 1 - t**3 / 90], axis=1)
    return types.SimpleNamespace(
        t=t, x=x, u=t[:, None] ** 4 / 30, costate=-x, reference_nodes=tau,
        final_time=breaks[-1], problem=EarthMars(), u_before=None,
    )  # fmt: skip


def flights(cases):
    t = np.linspace(0.0, 3.32, 9)
    nominal, _ = plotting.at(extremal(), t)
    x = nominal[None] + 1e-3 * np.arange(1, cases + 1)[:, None, None]
    du = np.full((cases, 8, 1), 1e-2)
    return types.SimpleNamespace(t=np.tile(t, (cases, 1)), x=x, u=du + 1, commands=du)


def dataset(rng, cases=200):
    final = np.array([1.5, 0.0, 0.8]) + rng.normal(size=(cases, 3)) * [1e-2, 1e-6, 1e-3]
    final[0] = np.nan
    cov = np.cov(final[1:].T)
    variables = {
        "final_state": (("case", "state"), final),
        "initial_state": (("case", "state"), final),
        "result": (("case",), np.r_[1, np.zeros(cases - 1, int)]),
    }
    attrs = {
        "nominal_final_state": [1.5, 0.0, 0.8],
        "sample_covariance": cov.tolist(),
        "linear_covariance": (1.1 * cov).tolist(),
    }
    return xr.Dataset(variables, coords={"state": ["r", "v_r", "v_t"]}, attrs=attrs)


def schedule():
    times = np.linspace(0.0, 3.3, 12)
    K = np.stack([times**2, -np.exp(times), 1 / (3.32 - times)], axis=1)[:, None, :]
    error, resolved = np.full(12, 1e-9), np.arange(12) < 11
    return types.SimpleNamespace(
        times=times, K=K, error=error, resolved=resolved, extremal=extremal()
    )


FIGURES = {
    "extremal": lambda rng: plotting.plot_extremal(extremal(), UNITS),
    "extremal without units": lambda rng: plotting.plot_extremal(extremal()),
    "gains": lambda rng: plotting.plot_gains(schedule(), UNITS),
    "flight": lambda rng: plotting.plot_flight(
        types.SimpleNamespace(**{k: v[0] for k, v in vars(flights(1)).items()}), extremal(), UNITS
    ),
    "state deviations": lambda rng: plotting.plot_deviations(flights(6), extremal(), "v_t"),
    "deviations of all": lambda rng: plotting.plot_deviations(flights(6), extremal(), STATES),
    "control deviations": lambda rng: plotting.plot_deviations(flights(2), extremal(), "epsilon"),
    "re-optimised": lambda rng: plotting.plot_reoptimised(
        flights(6), flights(6).x * 0.9, "r", STATES, units=UNITS
    ),
    "gain errors": lambda rng: plotting.plot_gain_errors(
        {"K(0)": {"a": ([9, 17], [1e-2, 1e-5])}, "K(2)": {"a": ([9, 17], [1e-3, 0.0])}}
    ),
    "sweep": lambda rng: plotting.plot_sweep(dataset(rng), UNITS),
}


@pytest.mark.parametrize("name", FIGURES)
def test_figures_draw(name, tmp_path):
    figure = FIGURES[name](np.random.default_rng(0))
    assert isinstance(figure, Figure)
    figure.savefig(tmp_path / "figure.png", dpi=50)
    for axis in figure.axes:
        lines = [line for line in axis.get_lines() if not str(line.get_label()).startswith("_")]
        dashes = [str(line._dash_pattern) for line in lines]  # pyright: ignore
        assert len(set(dashes)) == len(dashes)  # told apart without colour


def test_units_and_names_on_the_axes():
    figure = plotting.plot_extremal(extremal(), UNITS)
    assert figure.axes[-1].get_xlabel() == "$t$ [TU]"
    assert figure.axes[0].get_ylabel() == r"$\epsilon$ [rad]"
    legend = figure.axes[1].get_legend()
    assert legend is not None
    texts = [text.get_text() for text in legend.get_texts()]
    assert texts == ["$r$ [LU]", "$v_{r}$ [LU/TU]", "$v_{t}$ [LU/TU]"]


def test_unknown_name_is_refused():
    with pytest.raises(ValueError, match="'x' is no state"):
        plotting.plot_deviations(flights(1), extremal(), "x")


def test_a_failed_case_is_counted_and_left_out():
    figure = plotting.plot_sweep(dataset(np.random.default_rng(1)))
    assert "199 of 200 flights" in figure.get_suptitle()


def test_host_interpolation_is_exact_for_the_mesh_degree():
    e = extremal()
    t = np.concatenate([np.linspace(0, 3.32, 57), e.t])  # at nodes and between
    x, u = plotting.at(e, t)
    np.testing.assert_allclose(x[:, 2], 1 - t**3 / 90, atol=1e-14)
    np.testing.assert_allclose(u[:, 0], t**4 / 30, atol=1e-13)


@pytest.mark.parametrize("N", [2, 9, 64])
def test_host_differentiation_matrix_is_the_library_s(N):
    library = differentiation_matrix(jnp.asarray(nodes_lgl(N + 1)[0]))
    np.testing.assert_allclose(collocation.lgl_differentiation(N), library, atol=1e-12 * N**2)


def test_host_collocation_of_the_double_integrator():
    """K = (-6/T^2, -4/T): minimum effort to the origin, here T = 2."""
    A, B = np.array([[0.0, 1.0], [0.0, 0.0]]), -np.diag([0.0, 1.0])
    M = np.block([[A, B], [np.zeros((2, 2)), -A.T]])
    psi = np.concatenate([np.eye(2), np.zeros((2, 2))], axis=1)
    U = np.array([[0.0, 0.0, 0.0, -1.0]])
    t = nodes_lgl(9)[0] + 1
    system = collocation.HamiltonianSystem(np.tile(M, (9, 1, 1)), np.tile(U, (9, 1, 1)), psi)
    for square in (False, True):
        K = U @ collocation.collocated_horizon(t, system, square)[0]
        np.testing.assert_allclose(K, [[-1.5, -2.0]], atol=1e-12)


def test_a_jump_of_the_control_stays_at_its_break():
    e = extremal()
    e.u = np.where(e.t[:, None] >= 1.5, 1.0, 0.0)
    e.u_before, e.costate_before = np.array([[0.0], [0.0], [1.0]]), -e.x[P - 1 :: P - 1]
    _, u = plotting.at(e, np.array([0.5, 1.2, 1.49, 1.5, 2.0]))
    np.testing.assert_allclose(u[:, 0], [0, 0, 0, 1, 1], atol=1e-14)
