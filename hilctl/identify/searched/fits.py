"""Fits of plays whose thresholds are searched, from several starts."""

import numpy as np

from hilctl.identify.job import FitJob, FoundModel
from hilctl.identify.judge import weight_roots
from hilctl.identify.searched.integrated import ExponentialProblem
from hilctl.identify.searched.plays import PlaysProblem
from hilctl.identify.searched.search import SearchProblem, refine_peak, search


def fit_plays(job: FitJob) -> FoundModel:
    """Fit a PPI or an RDPI; its weights follow from its thresholds."""
    return _searched(PlaysProblem(job.data, job.settings), job)


def fit_exponential(job: FitJob) -> FoundModel:
    """Fit the integrated model with exponential weights."""
    return _searched(ExponentialProblem(job.data, job.settings), job)


def _searched(problem: SearchProblem, job: FitJob) -> FoundModel:
    data, settings = job.data, job.settings
    rng = np.random.default_rng(settings.seed)
    roots = weight_roots(data.records, settings.weight_by)
    scale = np.append(roots, np.ones(problem.held))
    found = search(problem, scale, data.stroke_um, settings.starts, rng, job.progress)
    if settings.peak_goal_percent is not None:
        goal_um = settings.peak_goal_percent / 100.0 * data.stroke_um
        found = refine_peak(problem, found, goal_um, job.progress)
    known = problem.parameters(found.x, found.scale)
    numbers = len(known.keys() - {"g_0"})  # which is 1 by definition
    at_bound = problem.space.at_bound(found.x)
    held = tuple(name for name, bound in zip(problem.searched, at_bound, strict=True) if bound)
    model = problem.build(found.x, found.scale)
    return FoundModel(model, numbers, known, found.starts, at_bound=held)
