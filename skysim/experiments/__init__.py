"""Many simulations, one answer: studies, the papers' experiments, the dome survey, tracker comparisons."""

import lazy_loader

# Loaded on first use: importing one module of the package does not import the others.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={"dome_survey.adjust": ["run_survey"], "study.api": ["StudyResult", "run_study"]},
)
