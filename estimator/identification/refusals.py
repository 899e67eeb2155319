"""Reasons why a frame is not solved, one constant text each, and the setting that would help an identifier.

A status depends on the frame only by its case, so that equal refusals are counted together.
"""

from math import inf

from estimator.identification.chance import MIN_MATCHES

NO_LIGHTS = "no lights detected"
NO_STARS = "too few stars detected"
NO_MATCH = "no identification beyond chance"
# The search has tried all that it can try, or its effort is used up.
FALSE_LIGHTS = f"{NO_MATCH}: too many false lights"
BUDGET = f"{NO_MATCH}: the budget of the search is used up"
# Evidence that is decisive at a focal length outside of the range that was given.
WRONG_SCALE = "wrong scale: the stars match at another focal length"
AMBIGUOUS = "ambiguous: another attitude fits the lights as well"

# Identifiers whose papers accept a match by a rule of their own (see `solver_options.Options.acceptance`).
OWN_RULE = ("saa", "shefex", "master_star", "fialho_1", "fialho_2", "fialho_3", "fialho_4")
CROWDED = 1.5  # lights per catalog star in a field from which the lights are too many


def advice(
    identifier: str,
    lights: int,
    acceptance: str,
    in_field: float = inf,
    cos_error: float | None = None,
) -> str:
    """The setting that would help a published identifier that has refused a field.

    Parameters
    ----------
    identifier
        Name of the method
    lights
        Number of lights that it was given
    acceptance
        See `solver_options.Options`
    in_field
        Mean number of its catalog's stars in a field; infinite if unknown
    cos_error
        The tolerance that is set for `shefex`, which then takes no other; None if none is
    """
    if lights < MIN_MATCHES:
        return (
            f"{identifier} needs {MIN_MATCHES} lights; lower threshold_sigma or min_area_px"
        )
    if lights > CROWDED * in_field:
        wanted = max(round(in_field), MIN_MATCHES)
        return (
            f"more lights than the {wanted} stars that the catalog of {identifier} has in a field; set brightest to"
            f" {wanted}, or limit_mag to a fainter one"
        )
    if identifier == "fialho_1":
        return "its lists of the whole catalog are too long; set identifier to fialho_2"
    wider = "centroid_sigma_px" if cos_error is None else "cos_error"
    if acceptance == "evidence" and identifier in OWN_RULE:
        return f"set acceptance to thesis for the paper's rule, without this test, or raise {wider}"
    return f"raise {wider}, or set another identifier"
