"""Design optimization: a sampler proposes one candidate point after another; each is evaluated by all its replicates.

The sampler is optuna's tree-structured Parzen estimator with constraints. It is seeded by the study and learns only
from rows in the store, so a resumed search proposes the same candidates again, finds their rows and continues after
them. The result is the feasible candidate with the best objective or, with two objectives, the Pareto front.
"""

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from skysim.core.errors import InputError, check_name
from skysim.core.types import Record
from skysim.core.units import in_si
from skysim.experiments.study.execution.engines import Engine
from skysim.experiments.study.execution.runner import Progress, Watch, run
from skysim.experiments.study.execution.store import TIMES, Store
from skysim.experiments.study.execution.trials import REFUSED, Row, Segment, blank_rows
from skysim.experiments.study.factors import (
    Distribution,
    Factor,
    Point,
    Range,
    Value,
    make_point,
    split_quantity,
)
from skysim.experiments.study.plan import Constraint, Cost, Plan, Search, Study, resolve_point
from skysim.experiments.study.table import format_level, format_summary
from skysim.results import metrics
from skysim.results.files.parts import parts_list

# Cost of a candidate of a search: prices of its factors, and the parts list of its scene's dome.


COST = "cost"


def check_cost(factors: Mapping[str, Factor], config: Cost) -> None:
    """Raise InputError for prices of unknown factors or levels, and for prices per unit of a factor without numbers."""
    for name in config.per:
        where = f"optimize.cost.per.{name}"
        check_name(where, "factor", name, factors)
        try:
            for value, _ in factors[name].options():
                si(value)
        except InputError as error:
            allowed = "numbers, or quantities with units; prices of named levels: optimize.cost.levels"
            raise InputError(where, error.problem, allowed) from None
    for name, prices in config.levels.items():
        where = f"optimize.cost.levels.{name}"
        check_name(where, "factor", name, factors)
        factor = factors[name]
        named = (
            [str(level) for level, _ in factor.options()]
            if not isinstance(factor, Range)
            else []
        )
        if sorted(named) != sorted(prices):
            allowed = (
                f"a price of each of {', '.join(named)}"
                if named
                else "optimize.cost.per, as it is a range"
            )
            raise InputError(where, f"prices {', '.join(prices) or 'nothing'}", allowed)


def si(value: Value) -> float:
    """A plain number unchanged, or a quantity in SI units: "48 in" is 1.2192. Raises InputError."""
    number, unit = split_quantity(value)
    return in_si(value) if unit else number


def cost(plan: Plan, point: Point) -> tuple[float, str]:
    """Cost of a point: base, `per` and `levels` of the factors, and the parts' total; if it is NaN, also the reason."""
    total = factors_cost(plan.study.search.cost, point.levels)
    if plan.prices is None:
        return total, ""
    try:
        scene, _ = resolve_point(plan.spec, point.settings)
        return total + parts_list(scene, plan.prices).total, ""
    except InputError as error:
        return math.nan, str(error)


def factors_cost(config: Cost, levels: Mapping[str, Value]) -> float:
    """base + sum of per[factor] * value + prices of the named levels, with values in SI units."""
    linear = sum(price * si(levels[name]) for name, price in config.per.items())
    named = sum(price[str(levels[name])] for name, price in config.levels.items())
    return config.base + linear + named


STARTUP_CANDIDATES = 10  # random candidates before the sampler uses earlier results
MAX_REPEATS = 50  # repeated proposals in succession after which all points count as evaluated
# Violation of a candidate without a value; larger than usual relative violations.
MISSING_VIOLATION = 1e3
MIN_SCALE = 1e-9  # scale of the relative violation of a bound of zero


class Candidate(NamedTuple):
    """One evaluated point.

    Attributes
    ----------
    figures
        Statistic of each response that is an objective or a constraint, and the cost
    feasible
        Whether all constraints hold for the values (intervals are ignored), and none is missing
    refused
        Whether its scene is invalid
    why
        Violated constraints, or error message of the scene; empty if feasible
    """

    number: int
    levels: dict[str, Value]
    objectives: tuple[float, ...]
    figures: dict[str, metrics.Summary]
    cost: float
    feasible: bool
    refused: bool
    why: str


class SearchResult(NamedTuple):
    """Result of a search.

    Attributes
    ----------
    front
        The Pareto-optimal feasible candidates, best in the first objective first; with one
        objective, the best
    finished
        Whether all candidates, or all existing points, were evaluated
    """

    candidates: list[Candidate]
    front: list[Candidate]
    finished: bool


class InvalidScene(Exception):
    """Raised when a candidate's scene is invalid, so that none of its trials can run."""


# Validation before the first trial.


def check(study: Study) -> None:
    """Validate section `optimize` of a study. Raises InputError with the key at fault."""
    config = study.search
    if not study.factors:
        raise InputError("factors", "missing: the search chooses their levels", "one or more")
    for n, objective in enumerate(config.objectives):
        check_response(objective.response, f"optimize.objectives.{n}.response")
    first, *others = (one.response for one in config.objectives)
    if first in others:
        raise InputError(
            "optimize.objectives", f"{first} occurs twice", "different responses"
        )
    for n, limit in enumerate(config.constraints):
        check_response(limit.response, f"optimize.constraints.{n}.response")
        if limit.at_least is None and limit.at_most is None:
            raise InputError(
                f"optimize.constraints.{n}", "no bound", "at_least, at_most or both"
            )
    for name, factor in study.factors.items():
        if isinstance(factor, Distribution):
            raise InputError(
                f"factors.{name}",
                "a distribution cannot be optimized",
                "levels, values, from and to",
            )
    check_cost(study.factors, config.cost)


def check_response(response: str, where: str) -> None:
    """Raise InputError for an unknown response and for one that is not reproducible (times)."""
    if response == COST:
        return
    try:
        metrics.response(response, where)
    except InputError as error:
        raise InputError(where, error.problem, f"{error.allowed}, or {COST}") from None
    if response.startswith(TIMES):
        allowed = "responses that a resumed search reproduces"
        raise InputError(where, f"{response} is not reproducible", allowed)


# Evaluation of a candidate.


def evaluate_candidate(
    plan: Plan, number: int, point: Point, columns: metrics.Columns
) -> Candidate:
    """The candidate computed from the columns of all its trials, and its cost."""
    config = plan.study.search
    figures = {
        name: metrics.response(name)(columns) for name in config.responses if name != COST
    }
    price, unpriced = cost(plan, point)
    figures[COST] = metrics.Summary(price)
    objectives = tuple(figures[one.response].value for one in config.objectives)
    violated = [one.response for one in config.constraints if violation(one, figures) > 0]
    violated += [
        f"no {one.response}"
        for one in config.objectives
        if math.isnan(figures[one.response].value)
    ]
    refused = scene_error(columns)
    why = refused or unpriced or ", ".join(violated)
    return Candidate(
        number, point.levels, objectives, figures, price, not why, bool(refused), why
    )


def violation(limit: Constraint, figures: Mapping[str, metrics.Summary]) -> float:
    """Relative violation of a constraint, (value - bound) / |bound|; <= 0 if it holds, MISSING_VIOLATION for NaN."""
    value = figures[limit.response].value
    if math.isnan(value):
        return MISSING_VIOLATION
    bounds = ((limit.at_most, 1), (limit.at_least, -1))
    return max(
        sign * (value - bound) / max(abs(bound), MIN_SCALE)
        for bound, sign in bounds
        if bound is not None
    )


def scene_error(columns: metrics.Columns) -> str:
    """Why a candidate's scene was rejected; empty if the scene is valid."""
    errors = zip(columns["scene"], columns["error"], strict=True)
    return next((str(error) for scene, error in errors if scene == REFUSED), "")


def front(config: Search, candidates: Sequence[Candidate]) -> list[Candidate]:
    """The Pareto front: feasible candidates that no other dominates.

    One candidate dominates another if it is at least as good in every objective and better in one.
    """
    feasible = [one for one in candidates if one.feasible]
    sign = np.array([1.0 if one.better == "less" else -1.0 for one in config.objectives])
    values = np.array([one.objectives for one in feasible]).reshape(-1, len(sign)) * sign
    return [
        feasible[n]
        for n in np.lexsort(values.T[::-1])
        if not np.any(
            np.all(values <= values[n], axis=1) & np.any(values < values[n], axis=1)
        )
    ]


def front_cells(study: Study, result: SearchResult) -> tuple[list[str], list[list[str]]]:
    """Column heads and cell texts of the front: candidate, levels, objectives and constrained responses."""
    named = [one.response for one in study.search.objectives]
    shown = named + [name for name in study.search.responses if name not in (*named, COST)]
    rows = []
    for one in result.front:
        figures = {name: format_summary(figure) for name, figure in one.figures.items()}
        figures[COST] = f"{one.cost:.4g}"
        levels = map(format_level, one.levels.values())
        rows.append([str(one.number), *levels, *(figures[name] for name in shown)])
    return ["candidate", *study.factors, *shown], rows


def front_columns(result: SearchResult) -> Record:
    """The candidates of the front, and the cost of every candidate; None if it has none."""
    costs = [None if math.isnan(one.cost) else one.cost for one in result.candidates]
    return {"front": [one.number for one in result.front], "costs": costs}


def collect_result(plan: Plan, store: Store) -> SearchResult:
    """The candidates in a store whose trials are complete, and their front; the search may be unfinished."""
    study = plan.study
    evaluated = []
    for n, point in enumerate(store.points()):
        columns = store.point_columns(n)
        if len(columns["trial"]) == study.replicates:
            evaluated.append(evaluate_candidate(plan, n, point, columns))
    finished = len(evaluated) == study.search.candidates
    return SearchResult(evaluated, front(study.search, evaluated), finished)


# The search.


def search(
    plan: Plan, store: Store, engine: Engine, watch: Watch | None = None
) -> SearchResult:
    """Evaluate candidates until `candidates` of them are complete, all points are evaluated, or the budget is spent.

    Raises InputError, also if optuna is not installed or proposes other candidates than those in the store.
    """
    study = plan.study
    config = study.search
    sampler = create_sampler(study)
    stored = store.points()
    total = Progress(config.candidates * study.replicates, **store.counts())
    evaluated: dict[str, Candidate] = {}
    for n in range(config.candidates):
        proposal, point = propose(sampler, study, evaluated)
        if point is None:
            return collect_result(plan, store)._replace(finished=True)
        if n >= len(stored):
            store.set_points([point], first=n)
        elif key_of(stored[n]) != key_of(point):
            raise InputError(
                store.path,
                f"candidate {n} is {stored[n].levels}, the sampler now proposes {point.levels}",
                "the version of optuna that started the search, or another store",
            )
        total.uncounted = study.replicates * sum(one.refused for one in evaluated.values())
        run_candidate(plan, store, engine, n, point, total, watch)
        columns = store.point_columns(n)
        if len(columns["trial"]) < study.replicates:  # the budget is spent
            return collect_result(plan, store)
        evaluated[key_of(point)] = evaluate_candidate(plan, n, point, columns)
        report_to_sampler(sampler, proposal, config, evaluated[key_of(point)])
    return collect_result(plan, store)


def create_sampler(study: Study) -> Any:
    """An optuna study with the tree-structured Parzen estimator (TPE), which handles one or two objectives.

    The first candidate is the middle of all factors. TPE learns after START candidates; NSGA-II would need a
    population of fifty.
    """
    try:
        import optuna
    except ImportError:
        raise InputError(
            "optimize", "optuna is not installed", "after pip install 'skysim[optuna]'"
        ) from None
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    seed = int(np.random.SeedSequence(study.seed).generate_state(1)[0])
    sampler = optuna.samplers.TPESampler(seed=seed, n_startup_trials=STARTUP_CANDIDATES)
    direction = {"less": "minimize", "more": "maximize"}
    directions = [direction[one.better] for one in study.search.objectives]
    optuna_study = optuna.create_study(sampler=sampler, directions=directions)
    middle = {
        name: 0.5 if isinstance(factor, Range) else len(factor.options()) // 2
        for name, factor in study.factors.items()
    }
    optuna_study.enqueue_trial(middle)
    return optuna_study


def propose(
    sampler: Any, study: Study, evaluated: dict[str, Candidate]
) -> tuple[Any, Point | None]:
    """The sampler's next proposal that has not been evaluated: optuna trial and point; (None, None) if there is none.

    A repeated proposal gets the known result, so that the sampler moves on.
    """
    for _ in range(MAX_REPEATS):
        # A number in [0, 1] for a range, an index for levels or values.
        proposal = sampler.ask()
        chosen = {}
        for name, factor in study.factors.items():
            if isinstance(factor, Range):
                chosen[name] = factor.value_at(proposal.suggest_float(name, 0.0, 1.0))
            else:
                options = factor.options()
                chosen[name] = options[
                    proposal.suggest_categorical(name, range(len(options)))
                ]
        point = make_point(chosen)
        if key_of(point) not in evaluated:
            return proposal, point
        report_to_sampler(sampler, proposal, study.search, evaluated[key_of(point)])
    return None, None


def key_of(point: Point) -> str:
    """Identity of a point: its settings as text."""
    return json.dumps(point.settings, sort_keys=True)


def report_to_sampler(
    sampler: Any, proposal: Any, config: Search, candidate: Candidate
) -> None:
    """Report a candidate's objectives and constraint violations to the sampler.

    A candidate without values gets infinitely bad objectives and an extra violated constraint.
    """
    for n, limit in enumerate(config.constraints):
        proposal.set_constraint(str(n), violation(limit, candidate.figures))
    valid = not candidate.refused and not any(math.isnan(one) for one in candidate.objectives)
    proposal.set_constraint("answered", 0.0 if valid else MISSING_VIOLATION)
    worst = [math.inf if one.better == "less" else -math.inf for one in config.objectives]
    sampler.tell(proposal, list(candidate.objectives) if valid else worst)


def run_candidate(
    plan: Plan,
    store: Store,
    engine: Engine,
    number: int,
    point: Point,
    total: Progress,
    watch: Watch | None,
) -> None:
    """Run the missing replicates of a candidate, until the budget of the whole search is spent.

    Parameters
    ----------
    total
        Progress of the whole search; failed trials of invalid scenes are uncounted in it
    """
    time_s = plan.study.budget.time_s
    if time_s is not None and total.seconds >= time_s:
        return

    def watch_candidate(progress: Progress) -> None:
        if watch:
            watch(progress)
        if progress.failed > progress.uncounted and scene_error(store.point_columns(number)):
            raise InvalidScene

    try:
        run(plan, store, engine, watch_candidate, [point], number, total)
    except InvalidScene:
        rows = failed_rows(plan, store, number)
        store.add(rows)
        total.add(rows)


def failed_rows(plan: Plan, store: Store, number: int) -> list[Row]:
    """Rows for the remaining trials of a candidate with an invalid scene: failed, with the error of the first one."""
    columns = store.point_columns(number)
    each = plan.study.replicates
    error = scene_error(columns)
    return [
        row._replace(scene=REFUSED, error=error)
        for row in blank_rows(plan.spec, Segment(number, {}, number * each, range(each)))
        if row.replicate not in columns["replicate"]
    ]
