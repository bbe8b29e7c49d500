"""The report's sections: each computes, and judges against its reference or against theory."""

import numpy as np

from jaxguide.reproduce.ps_review import (
    boundary,
    covectors,
    duality,
    gaussian,
    infinite,
    rates,
    uniform,
    weighted,
)
from jaxguide.reproduce.ps_review.published import (
    CONTROL_ERRORS,
    INFINITE,
    LEAST_WEIGHT,
    NEGATIVE_WEIGHTS,
    POSITIVE_POINTS,
    TABLE_1,
    cost_rate,
    residual_rate,
    state_rate,
)
from jaxguide.reproduce.report import Report, Section

EPS = float(np.finfo(float).eps)
NAMES = {"lgl": "LGL", "lgr-left": "LGR", "lgr-right": "LGR (+1)", "lg": "LG", "cgl": "CGL"}


def interpolants(report: Report) -> None:
    """Review, eqs. (10)-(16), figures 4 and 5."""
    section = report.section(
        "Weighted interpolants (eqs 10-16; figures 4 and 5)",
        "By the library's matrices, on 8 arbitrary points (the paper prints none, nor its W; here "
        "W = 1 - t). The weight keeps the values and changes the slopes: constants are no longer "
        "differentiated exactly, W times a polynomial is. On Radau nodes eq. (16) with W = 1 - t "
        "gives the Radau weights themselves, because Gauss quadrature is exact for W phi_j.",
    )
    found = weighted.matrix_defects()
    n = len(weighted.ARBITRARY)
    limit = n**2 * EPS * 10  # rounding of D, n^2 eps, times W_i/W_j (at most 19) and values below 1
    section.add(
        "max |W(t_i)/W(t_j) phi_j(t_i) - delta_ij|", found["Kronecker"], 0, tolerance=0.0,
        note="eq. (9) holds for any W",
    )  # fmt: skip
    section.add("D on W t^k, k = 0...7: error", found["derivative"], 0, tolerance=limit * 19)
    section.add("w on W t^k, k = 0...7: error", found["integral"], 0, tolerance=limit)
    section.add("D on constants, W = 1", found["constants, W = 1"], 0, tolerance=limit)
    section.add("D on constants, W = 1 - t", found["constants, W = 1 - t"], note="nor should it")
    section.add("slope of the basis at its own node, W = 1", found["slope, W = 1"])
    section.add(
        "the same, W = 1 - t", found["slope, W = 1 - t"], found["slope, W = 1"] + found["shift"],
        tolerance=limit, note="eq. (12): the plain one plus W'/W",
    )  # fmt: skip
    section.add(
        "LGR, 12 points: max |w of eq. (16) - Radau weights|", weighted.radau_weights(12), 0,
        tolerance=12**2 * EPS,
    )  # fmt: skip
    for points in (8, 16):
        with_weight, plain = weighted.decay(points)
        section.add(
            f"(1-t)/(5-t), LGR {points}: error of its slope, W = 1 - t", with_weight,
            note=f"W = 1: {plain:.2g}",
        )  # fmt: skip


def uniform_grids(report: Report) -> None:
    """Review, problem E1, figures 7 and 8."""
    section = report.section(
        "E1 on uniform grids (figures 7 and 8)",
        "A linear program, solved as it stands by HiGHS (scipy) and in closed form: minimise w.u "
        "with v.u = 0 (v^T D = 0) and u >= -1, bounded if and only if some gamma has "
        "w_i >= gamma v_i for all i. The paper: positive weights are required, and at 11 points or "
        "more some are negative. So they are, but positive weights (gamma = 0) are sufficient, not "
        "necessary: on 9 and 11 points weights are negative and yet u = -1 is the only solution; "
        "from 12 points on no gamma is left and x(2) has no lower bound. Nor does it begin at 11: "
        "9 points have negative weights and 10 have none.",
    )
    for points in range(8, 17):
        found = uniform.solve_e1(points)
        printed = {} if points != POSITIVE_POINTS else {"printed": 0}
        reference = LEAST_WEIGHT.get(points)
        digits = {} if reference is None else {"tolerance": 5e-4 if points == 12 else 5e-5}
        note = f"gamma between {found.gamma[0]:.3g} and {found.gamma[1]:.3g}"
        section.add(
            f"{points} points: least weight", found.w.min(), reference, **digits,
            note=note + (": none" if not found.bounded_by_dual else ""),
        )  # fmt: skip
        count = np.sum(found.w < 0)
        known = NEGATIVE_WEIGHTS.get(points)
        exact = {} if known is None else {"tolerance": 0.0}
        section.add(f"{points} points: negative weights", count, known, **exact, **printed)
        section.add(
            f"{points} points: unbounded below", found.unbounded, not found.bounded_by_dual,
            tolerance=0.0, note="HiGHS, against the closed form",
        )  # fmt: skip
        if found.u is not None:
            error = np.max(np.abs(found.u + 1))
            limit = points * EPS * uniform.condition(found.x)
            section.add(f"{points} points: max |u + 1|", error, 0, tolerance=limit)
    for bound in (10.0, 100.0):
        found = uniform.program(np.linspace(-1, 1, 12), bound)
        section.add(
            f"12 points, u <= {bound:g} as well: x(2)", found.fun,
            note="the optimum is -2; the control is in figure 8",
        )  # fmt: skip


CASES = (  # family, ends extrapolated, weight
    ("lgl", False, "1"),
    ("lgr-left", False, "1"),
    ("lgr-right", False, "1"),
    ("lg", False, "1"),
    ("lgr-left", True, "1"),
    ("lgr-right", True, "1"),
    ("lg", True, "1"),
    ("lgr-left", False, "1-t"),
)


def gaussian_grids(report: Report) -> None:
    """Review, problem E2, figure 9."""
    section = report.section(
        "E2 on Gaussian grids of 10 points (figure 9)",
        "One quadratic program each, by a primal-dual active-set method whose last step is a dense "
        "KKT solve. max |u - 1|: 1 is the bound itself. Where e(x_0, x_N) is taken at the first "
        "and last node though these are no ends, the interpolant is free beyond them: the control "
        "runs into its bounds, and with -1 no node the problem is not even convex (curvature < 0; "
        "the point found meets the first-order conditions). "
        "With the ends extrapolated LGR and LG are as good as LGL with W = 1; the paper's "
        "statement on W = 1 is true of its B^N, which has x_0 and x_N in e. W = 1 - t is no cure: "
        "x_2 and x_1 then vanish at the end, and no point within the bounds is left.",
    )
    for family, extrapolated, weight in CASES:
        found = gaussian.solve_e2(family, 10, extrapolated, weight)
        how = "extrapolated" if extrapolated else "first and last node"
        name = f"{NAMES[family]}, ends: {how}, W = {weight}"
        reference = CONTROL_ERRORS.get((family, extrapolated))
        note = f"curvature {found.curvature:.1e}"
        if not found.feasible:
            section.add(f"{name}: feasible", found.feasible, 0, tolerance=0.0, note="by HiGHS")
        elif family == "lgl" or extrapolated:
            if reference is not None:
                note += f"; the reference's optimiser reached {reference:g}"
            section.add(name, found.error, 0, tolerance=found.rounding, note=note)
        else:
            known = 1.0 if reference is None else reference
            section.add(name, found.error, known, tolerance=1e-12, note=note)
            section.add(
                "   its first-order conditions", found.violation, 0, tolerance=found.rounding
            )


def table_1(report: Report) -> None:
    """Review, Table 1."""
    section = report.section(
        "Table 1: which weight, which grid, which ends",
        "W = 1 for the state throughout; W* of the costate decides. Discrete integration by parts, "
        "w_i D_ij + w_j D*_ji = 1 at a node at +1, -1 at one at -1, else 0, holds to rounding for "
        "the printed pairs and for no other here; where W* vanishes, the costate does, and the "
        "end is free. Below, one problem with the same solution whatever ends are fixed, with the "
        "ends in e taken at the first and last node: max |x_i - x(t_i)|. Spectral where the table "
        "allows, algebraic where it does not: order 4, because x is flat at its ends; the last "
        "node is O(n^-2) away. More than the table says: extrapolated ends make any of the grids "
        "fit any ends, and Radau nodes serve two free ends as well. Clenshaw-Curtis weights are "
        "not exact enough for the identity (see CGL below).",
    )
    for family in boundary.GRIDS:
        for weight in duality.WEIGHTS:
            if family == "lgl" and weight != "1" or family == "lgr-left" and weight == "1-t^2":
                continue  # W = 0 at a node
            pair = TABLE_1[family][0] == weight
            limits = {"reference": 0, "tolerance": 12**2 * EPS} if pair else {}
            section.add(
                f"{NAMES[family]}, W* = {weight}: by parts, 12 points",
                duality.by_parts_defect(family, weight, 12), **limits,
                note="in Table 1" if pair else "",
            )  # fmt: skip
    section.add("CGL, W* = 1: by parts, 12 points", duality.by_parts_defect("cgl", "1", 12))
    for family in boundary.GRIDS:
        for kind in boundary.ENDS:
            errors = {n: boundary.error(family, kind, n) for n in (8, 16, 32)}
            allowed = {"lgl": boundary.ENDS, "lgr-left": ("fixed-free", "free-free")}
            order = np.log2(errors[16] / errors[32])
            fits = kind in allowed.get(family, ("free-free",))
            listed = TABLE_1[family][1] in ("any", kind)
            note = ", ".join(f"{n}: {e:.1e}" for n, e in errors.items() if n < 32)
            note += ("" if fits else f"; order {order:.1f}") + ("; in Table 1" if listed else "")
            limits = {"reference": 0, "tolerance": 32**2 * EPS} if fits else {}
            section.add(f"{NAMES[family]}, {kind}, 32 points", errors[32], **limits, note=note)
    for family in ("lgr-left", "lg"):
        for kind in boundary.ENDS:
            error = boundary.error(family, kind, 32, extrapolated=True)
            name = f"{NAMES[family]}, {kind}, ends extrapolated, 32 points"
            section.add(name, error, 0, tolerance=32**2 * EPS)


def covector_mapping(report: Report) -> None:
    """Review, figure 6, eqs. (23)-(25), Proposition 1, Remark 3."""
    section = report.section(
        "The covector mapping diagram (figure 6; eqs 23-25; Proposition 1)",
        "x1' = x2, x2' = -t x1 + u, with the target for which x1 = sin(3t + 0.4) is optimal; "
        "errors of both costates relative to the greatest. Discretise, then dualise: "
        "-multiplier/weight, raw, and for LGL less the null mode gamma P_N fixed by both closure "
        "conditions. Dualise, then discretise: state and costate equations collocated, u from "
        "H_u = 0 (LGL: one equation more than unknowns for each, by least squares; the residual is "
        "delta^N). The two ways around agree to rounding at all n on LG and spectrally on LGR and "
        "LGL.",
    )
    for family in ("lgl", "lgr-right", "lg"):
        for points in (8, 12, 16, 24):
            e = covectors.errors(family, points)
            last = points == 24
            limits = {"reference": 0, "tolerance": points**2 * EPS} if last else {}
            name = f"{NAMES[family]}, {points} points"
            if family == "lgl":
                note = f"largest gamma {e.mode:.1e}"
                section.add(f"{name}: raw", e.raw, note=note)
            section.add(f"{name}: discretise, dualise", e.closed, **limits)
            note = f"delta^N = {e.consistency:.1e}" if family == "lgl" and not last else ""
            section.add(f"{name}: dualise, discretise", e.dual, **limits, note=note)
            section.add(f"{name}: closure conditions", e.closure, **limits)
            if family == "lg":
                limits = {"reference": 0, "tolerance": points**2 * EPS}
            section.add(f"{name}: between the two", e.gap, **limits)
    _null_mode(report)
    _proposition_1(report)


def _null_mode(report: Report) -> None:
    section = report.section(
        "The null mode, bare: E1 on LGL",
        "u is at its bound and hides the costate, lambda = 1: the multipliers 1 + gamma P_N are "
        "valid with every gamma of the interval of E1's dual (-1 to 1 for odd N), and the simplex "
        "method ends at a corner of it. The closure condition lambda(2) = 1 leaves gamma = 0. "
        "The paper's other method, Chebyshev (Remark 3), on the oscillator above: Clenshaw-Curtis "
        "weights integrate exactly to degree N only, the integration by parts of Table 1 fails, "
        "and the solution of B^N, multipliers over weights and controls alike, converges about as "
        "n^-2.",
    )
    for points in (10, 20):
        raw, closed = uniform.lobatto_costate(points)
        off = lambda y: np.max(np.abs(y - 1))
        name = f"LGL, {points} points: max |lambda - 1|"
        section.add(f"{name}, raw", off(raw), 1, tolerance=points**2 * EPS)
        section.add(f"{name}, closed", off(closed), 0, tolerance=points**2 * EPS)
    for points in (16, 32, 64):
        e = covectors.errors("cgl", points)
        name = f"CGL, {points} points, oscillator: multiplier/weight"
        section.add(name, e.raw, note=f"dualise, discretise: {e.dual:.1e}")


def _proposition_1(report: Report) -> None:
    section = report.section(
        "Proposition 1: P is diagonal, 1/w",
        "x' = t x + u, 8 points. Column by column: the target for which B^N has a unit vector of "
        "multipliers, and the costate that problem B^{lambda N} with D* of W* has for it. Here "
        "g = D X - f, so P = -1/w. Largest entry of P off the diagonal, and |P_ii w_i + 1|. With "
        "the wrong W* there is no such P.",
    )
    for family, weight in (("lgr-left", "1-t"), ("lg", "1-t^2"), ("lg", "1-t")):
        P, rounding = duality.mapping_matrix(family, weight, 8)
        diagonal = np.diag(P)
        weights = boundary.review_grid(family, 8).w
        pair = TABLE_1[family][0] == weight
        limits = {"reference": 0, "tolerance": rounding} if pair else {}
        name = f"{NAMES[family]}, W* = {weight}"
        off = np.max(np.abs(P - np.diag(diagonal)))
        section.add(f"{name}: off the diagonal", off, **limits)
        section.add(f"{name}: diagonal", np.max(np.abs(diagonal * weights + 1)), **limits)


def infinite_horizon(report: Report) -> None:
    """Review, eq. (6), and W = 1 - t of Table 1."""
    section = report.section(
        "An infinite horizon: LGR, W = 1 - t, bilinear map (eq. 6)",
        "x' = x + u, cost x^2 + u^2, x(0) = 1: J = 1 + sqrt 2 = 2.41421356... Here W = 1 does as "
        "well, since the running cost drives x to 0 at the end by itself. The reference gives "
        "orders of magnitude: judged to half a decade; below 1e-14 counts as 1e-14.",
    )
    for points, reference in INFINITE.items():
        error = infinite.regulator_cost(points) - infinite.VALUE
        plain = infinite.regulator_cost(points, "1") - infinite.VALUE
        section.add(
            f"{points} points: log10 of the error of J", np.log10(max(abs(error), 1e-14)),
            np.log10(reference), tolerance=0.5, note=f"{error:.2e}; with W = 1: {plain:.2e}",
        )  # fmt: skip


def convergence(report: Report) -> None:
    """Review, section 4.3: Theorem 2, and Kang's rate of the cost."""
    section = report.section(
        "Rates: Theorem 2, and Kang's for the cost (section 4.3)",
        "x' = u on LGL, 8 to 128 points. x = sin 2t + sgn(t-c) (t-c)^m is in W^{m,inf}. Slopes of "
        "log error over log(N - 1). Theorem 2: u_i = u(t_i), the least residual delta^N of B^N "
        "(closed form) and the state's error at it. The optimal solutions: of the problem that "
        "tracks the target for which x is optimal, so that the running cost has the jump, where "
        "the theorems ask for smooth data; and, with smooth data, of x^2 + u^2 with |u| <= 1, "
        "whose control has a corner. The promised rates are bounds: a slope passes when it is no "
        "flatter. Theorem 6 promises convergence and no rate; the measured ones beat the bounds.",
    )
    for m in (2, 3, 4):
        errors = np.array([rates.feasible(n, m) + rates.optimal(n, m) for n in rates.SIZES])
        slopes = [rates.slope(rates.SIZES, e) for e in errors.T]
        _bound(section, f"m = {m}: least residual", slopes[0], residual_rate(m))
        _bound(section, f"m = {m}: feasible state", slopes[1], state_rate(m))
        _bound(section, f"m = {m}: optimal cost", slopes[2], cost_rate(m))
        section.add(f"m = {m}: slope of the optimal state", slopes[3])
        section.add(f"m = {m}: slope of the optimal control", slopes[4])
    errors = np.array([rates.Saturated.errors(n) for n in rates.SIZES])
    cost, state = (rates.slope(rates.SIZES, e) for e in errors.T)
    _bound(section, "|u| <= 1, m = 2: optimal cost", cost, cost_rate(2))
    section.add("|u| <= 1, m = 2: slope of the optimal state", state)
    for points in (8, 11, 16, 23):
        residual, feasible = rates.feasible(points, None)
        cost, state, control = rates.optimal(points, None)
        limits = {"reference": 0, "tolerance": points**2 * EPS} if points == 23 else {}
        note = f"least residual {residual:.1e}, feasible state {feasible:.1e}, cost {cost:.1e}"
        section.add(f"smooth, {points} points: optimal state", state, **limits, note=note)
        section.add(f"smooth, {points} points: optimal control", control, **limits)


def _bound(section: Section, name: str, slope: float, bound: float) -> None:
    """Judges by how much a slope is flatter than promised: by nothing."""
    note = f"slope {slope:.2f}, promised {bound:.2f} or steeper"
    over = max(slope - bound, 0.0) if np.isfinite(slope) else np.nan
    section.add(f"{name}: slope above the promise", over, 0, tolerance=0.0, note=note)


ALL = {
    "interpolants": interpolants,
    "uniform grids": uniform_grids,
    "Gaussian grids": gaussian_grids,
    "Table 1": table_1,
    "covectors": covector_mapping,
    "infinite horizon": infinite_horizon,
    "rates": convergence,
}
