"""Design optimization: a sampler proposes candidate points one after another, each evaluated by all its replicates.

The sampler is optuna's tree-structured Parzen estimator with constraints. It is seeded by the study and learns only
from rows in the store, so a resumed search proposes the same candidates again, finds their rows and continues after
them. The result is the feasible candidate with the best objective or, with two objectives, the Pareto front.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from skysim.core.errors import InputError
from skysim.core.units import in_si
from skysim.experiments.study.designs import Point, merged
from skysim.experiments.study.execution.engines import Engine
from skysim.experiments.study.execution.runner import Progress, Watch, run_points
from skysim.experiments.study.factors import Distribution, Factor, Levels, Range, Value, split
from skysim.experiments.study.plan import Constraint, Plan, Search, Study
from skysim.experiments.study.setups import code_version, seed_of
from skysim.experiments.study.store import Store
from skysim.experiments.study.trials import FAILED, Row
from skysim.results import metrics
from skysim.results.metrics import Columns, Summary

COST = "cost"
START = 10  # random candidates before the sampler uses earlier results
REPEATS = 50  # repeated proposals in succession after which all points count as tried
UNANSWERED = 1e3  # violation of a candidate without a value; larger than usual relative violations
LEAST = 1e-9  # scale of the relative violation of a bound of zero


class Candidate(NamedTuple):
    """One evaluated point.

    figures  : statistic of each response that is an objective or a constraint
    feasible : all constraints hold for the values (intervals are ignored), and no value is missing
    refused  : its scene is invalid
    why      : the violated constraints, or the error message of the scene; empty if feasible
    """

    number: int
    levels: dict[str, Value]
    objectives: tuple[float, ...]
    figures: dict[str, Summary]
    cost: float
    feasible: bool
    refused: bool
    why: str


class Found(NamedTuple):
    """Result of a search.

    front    : the Pareto-optimal feasible candidates, best in the first objective first; with one objective, the best
    finished : whether all candidates, or all existing points, were evaluated
    """

    candidates: list[Candidate]
    front: list[Candidate]
    finished: bool


class Refused(Exception):
    """Raised when a candidate's scene is invalid, so that none of its trials can run."""


# Validation before the first trial.


def check(study: Study) -> None:
    """Validate section `optimise` of a study. Raises InputError with the key at fault."""
    wanted = study.optimise
    if wanted is None:
        return
    for n, objective in enumerate(wanted.objectives):
        known(objective.response, f"optimise.objectives.{n}.response")
    if len({one.response for one in wanted.objectives}) < len(wanted.objectives):
        raise InputError(
            f"optimise.objectives: {wanted.objectives[0].response} twice; allowed: two that differ"
        )
    for n, limit in enumerate(wanted.constraints):
        known(limit.response, f"optimise.constraints.{n}.response")
        if limit.at_least is None and limit.at_most is None:
            raise InputError(f"optimise.constraints.{n}: allowed: at_least, at_most or both")
    for name, factor in study.factors.items():
        if isinstance(factor, Distribution):
            raise InputError(
                f"factors.{name}: nobody chooses a distribution; allowed: levels, values, from and to"
            )
    check_cost(study, wanted)
    asked, most = wanted.candidates * study.replicates, study.budget.trials
    if most is not None and asked > most:
        raise InputError(f"budget.trials: {most} are fewer than the search's {asked}")


def known(response: str, where: str) -> None:
    """Raise InputError for an unknown response and for one that is not reproducible (time_ms)."""
    if response == COST:
        return
    try:
        metrics.response(response, where)
    except InputError as error:
        raise InputError(f"{error}, or {COST}") from None
    if response.startswith("time_ms"):
        raise InputError(
            f"{where}: {response} is another every time; allowed: what a resumed search finds again"
        )


def check_cost(study: Study, wanted: Search) -> None:
    """Raise InputError for prices of unknown factors or levels, and for prices per unit of a factor without numbers."""
    priced: dict[str, Factor] = dict(study.factors)
    for name in wanted.cost.per:
        where = f"optimise.cost.per.{name}"
        factor = one_of(name, priced, where)
        values = [value for value, _ in factor.options()]
        try:
            for value in values if not isinstance(factor, Levels) else [values[0]]:
                si(value)
        except ValueError as error:
            raise InputError(
                f"{where}: {error}; a named level has its price in optimise.cost.levels"
            ) from None
    for name, prices in wanted.cost.levels.items():
        where = f"optimise.cost.levels.{name}"
        factor = one_of(name, priced, where)
        named = [str(level) for level, _ in factor.options()] if not isinstance(factor, Range) else []
        if sorted(named) != sorted(prices):
            allowed = (
                f"a price of each of {', '.join(named)}" if named else "optimise.cost.per, as it is a range"
            )
            raise InputError(f"{where}: prices {', '.join(prices) or 'nothing'}; allowed: {allowed}")


def one_of(name: str, factors: dict[str, Factor], where: str) -> Factor:
    """The factor with a name. Raises InputError if there is none."""
    if name not in factors:
        raise InputError(f"{where}: {name!r} is none of {', '.join(factors)}")
    return factors[name]


def si(value: Value) -> float:
    """A plain number unchanged, or a quantity in SI units: "48 in" is 1.2192. Raises ValueError."""
    number, unit = split(value)
    return in_si(value) if unit else number


def cost(wanted: Search, levels: dict[str, Value]) -> float:
    """Cost of a point: base + sum of per[factor] * value + prices of the named levels, with values in SI units."""
    told = wanted.cost
    linear = sum(price * si(levels[name]) for name, price in told.per.items())
    return told.base + linear + sum(prices[str(levels[name])] for name, prices in told.levels.items())


# Evaluation of a candidate.


def judged(study: Study, number: int, point: Point, columns: Columns) -> Candidate:
    """The candidate computed from the columns of all its trials."""
    wanted = study.optimise
    assert wanted is not None
    asked = [one.response for one in wanted.objectives] + [one.response for one in wanted.constraints]
    figures = {name: metrics.response(name)(columns) for name in dict.fromkeys(asked) if name != COST}
    price = cost(wanted, point.levels)
    worth = {name: figure.value for name, figure in figures.items()} | {COST: price}
    objectives = tuple(worth[one.response] for one in wanted.objectives)
    missed = [one.response for one in wanted.constraints if misses(one, worth[one.response]) > 0]
    missed += [f"no {one.response}" for one in wanted.objectives if math.isnan(worth[one.response])]
    refused = refusal(columns)
    why = told(refused) or ", ".join(missed)
    return Candidate(number, point.levels, objectives, figures, price, not why, bool(refused), why)


def misses(limit: Constraint, value: float) -> float:
    """Relative violation of a constraint, (value - bound) / |bound|; <= 0 if it holds, UNANSWERED for NaN."""
    if math.isnan(value):
        return UNANSWERED
    over = [] if limit.at_most is None else [(value - limit.at_most) / max(abs(limit.at_most), LEAST)]
    under = [] if limit.at_least is None else [(limit.at_least - value) / max(abs(limit.at_least), LEAST)]
    return max(over + under)


def refusal(columns: Columns) -> str:
    """Traceback of the InputError with which a candidate's scene was rejected; empty if the scene is valid.

    Trials of an invalid scene have an empty scene hash.
    """
    refused = [
        error
        for scene, error in zip(columns["scene"], columns["error"], strict=True)
        if not scene and error and InputError.__name__ in error.strip().splitlines()[-1]
    ]
    return refused[0] if refused else ""


def told(error: str) -> str:
    """Last line of a traceback without the exception's name."""
    return error.strip().splitlines()[-1].partition(f"{InputError.__name__}: ")[2] if error else ""


def front(wanted: Search, candidates: Sequence[Candidate]) -> list[Candidate]:
    """The Pareto front: feasible candidates that no other dominates.

    One candidate dominates another if it is at least as good in every objective and better in one.
    """
    feasible = [one for one in candidates if one.feasible]
    sign = np.array([1.0 if one.better == "less" else -1.0 for one in wanted.objectives])
    values = np.array([one.objectives for one in feasible]).reshape(-1, len(sign)) * sign
    best = [
        n
        for n, one in enumerate(values)
        if not np.any(np.all(values <= one, axis=1) & np.any(values < one, axis=1))
    ]
    return [feasible[n] for n in sorted(best, key=lambda n: tuple(values[n]))]


def found(plan: Plan, store: Store) -> Found:
    """The candidates in a store whose trials are complete, and their front; the search may be unfinished."""
    study, replicates = plan.study, plan.study.replicates
    assert study.optimise is not None
    columns = ((n, point, store.of_point(n)) for n, point in enumerate(store.points()))
    tried = [judged(study, n, point, own) for n, point, own in columns if len(own["trial"]) == replicates]
    return Found(tried, front(study.optimise, tried), len(tried) == study.optimise.candidates)


# The search.


def search(plan: Plan, store: Store, engine: Engine, watch: Watch | None = None) -> Found:
    """Evaluate candidates until `candidates` of them are complete, all points are tried, or the budget is spent.

    Raises InputError, also if optuna is not installed or proposes other candidates than those in the store.
    """
    study, wanted = plan.study, plan.study.optimise
    assert wanted is not None
    sampler, stored = begun(study), store.points()
    whole = Progress(wanted.candidates * study.replicates, **store.counts())
    tried: dict[str, Candidate] = {}
    for n in range(wanted.candidates):
        asked, point = question(sampler, study, tried)
        if point is None:
            return found(plan, store)._replace(finished=True)
        if n >= len(stored):
            store.set_points([point], first=n)
        elif key_of(stored[n]) != key_of(point):
            raise InputError(
                f"{store.path}: candidate {n} was {stored[n].levels}, now the sampler asks for {point.levels};"
                " allowed: the version of optuna that began it, or another --out"
            )
        refused = study.replicates * sum(one.refused for one in tried.values())
        if not answered(plan, store, engine, n, point, whole, refused, watch):
            return found(plan, store)
        tried[key_of(point)] = judged(study, n, point, store.of_point(n))
        tell(sampler, asked, wanted, tried[key_of(point)])
    return found(plan, store)


def begun(study: Study) -> Any:
    """An optuna study with the tree-structured Parzen estimator (TPE), which handles one or two objectives.

    The first candidate is the middle of all factors. TPE learns after START candidates; NSGA-II would need a
    population of fifty.
    """
    try:
        import optuna
    except ImportError:
        raise InputError("optimise: takes optuna; allowed: after pip install 'skysim[optuna]'") from None
    assert study.optimise is not None
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    seed = int(np.random.SeedSequence(study.seed).generate_state(1)[0])
    sampler = optuna.samplers.TPESampler(seed=seed, n_startup_trials=START)
    directions = ["minimize" if one.better == "less" else "maximize" for one in study.optimise.objectives]
    made = optuna.create_study(sampler=sampler, directions=directions)
    middle = {
        name: 0.5 if isinstance(factor, Range) else len(factor.options()) // 2
        for name, factor in study.factors.items()
    }
    made.enqueue_trial(middle)
    return made


def asked_of(study: Study) -> dict[str, Any]:
    """Search space of the sampler: a number in [0, 1] for a range, an index for levels or values."""
    from optuna.distributions import CategoricalDistribution, FloatDistribution

    return {
        name: FloatDistribution(0.0, 1.0)
        if isinstance(factor, Range)
        else CategoricalDistribution(tuple(range(len(factor.options()))))
        for name, factor in study.factors.items()
    }


def question(sampler: Any, study: Study, tried: dict[str, Candidate]) -> tuple[Any, Point | None]:
    """The sampler's next proposal that was not evaluated yet: optuna trial and point; (None, None) if there is none.

    A repeated proposal is answered with the known result, so that the sampler moves on.
    """
    assert study.optimise is not None
    for _ in range(REPEATS):
        asked = sampler.ask(asked_of(study))
        chosen = {
            name: factor.at(asked.params[name])
            if isinstance(factor, Range)
            else factor.options()[asked.params[name]]
            for name, factor in study.factors.items()
        }
        point = merged(chosen)
        if key_of(point) not in tried:
            return asked, point
        tell(sampler, asked, study.optimise, tried[key_of(point)])
    return None, None


def key_of(point: Point) -> str:
    """Identity of a point: its settings as text."""
    return json.dumps(point.settings, sort_keys=True)


def tell(sampler: Any, asked: Any, wanted: Search, candidate: Candidate) -> None:
    """Report a candidate's objectives and constraint violations to the sampler.

    A candidate without values gets infinitely bad objectives and an extra violated constraint.
    """
    worth = {name: figure.value for name, figure in candidate.figures.items()} | {COST: candidate.cost}
    for n, limit in enumerate(wanted.constraints):
        asked.set_constraint(str(n), misses(limit, worth[limit.response]))
    there = not candidate.refused and not any(math.isnan(one) for one in candidate.objectives)
    asked.set_constraint("answered", 0.0 if there else UNANSWERED)
    worst = [math.inf if one.better == "less" else -math.inf for one in wanted.objectives]
    sampler.tell(asked, list(candidate.objectives) if there else worst)


def answered(
    plan: Plan,
    store: Store,
    engine: Engine,
    number: int,
    point: Point,
    whole: Progress,
    refused: int,
    watch: Watch | None,
) -> bool:
    """Run the missing replicates of a candidate. Returns False if the budget is spent before all are in the store.

    whole   : progress of the whole search, passed to `watch`
    refused : number of failed trials of invalid scenes, which the budget does not count
    """
    # Budgets are for the whole search: subtract the time spent, and the failures of earlier candidates.
    before, budget = replace(whole), plan.study.budget
    left_s = None if budget.time_s is None else budget.time_s - (time.perf_counter() - whole.began)
    if left_s is not None and left_s <= 0:
        return False
    budget = budget.model_copy(
        update={"time_s": left_s, "failures": budget.failures and budget.failures + refused - before.failed}
    )
    limited = replace(plan, study=plan.study.model_copy(update={"budget": budget}))

    def look(progress: Progress) -> None:
        whole.now, whole.done = before.now + progress.now, before.done + progress.now
        whole.failed, whole.wrong = progress.failed, before.wrong + progress.wrong
        if watch:
            watch(whole)
        if progress.failed > refused and refusal(store.of_point(number)):
            raise Refused

    try:
        progress = run_points(limited, store, engine, [point], number, look)
    except Refused:
        rows = none_of(plan, store, number)
        store.add(rows)
        whole.add(rows)
        return True
    return progress.done == progress.trials


def none_of(plan: Plan, store: Store, number: int) -> list[Row]:
    """Rows for the remaining trials of a candidate with an invalid scene: failed, with the error of the first one."""
    columns, replicates = store.of_point(number), plan.study.replicates
    why, there = refusal(columns), set(columns["replicate"].tolist())
    return [
        Row(
            number * replicates + k,
            number,
            k,
            seed_of(plan.recipe, number, k),
            "",
            code_version(),
            FAILED,
            why,
            0.0,
        )
        for k in range(replicates)
        if k not in there
    ]
