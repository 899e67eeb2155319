"""Number of LEDs on a spiral that accuracy asks for, if their codes name them.

`python -m benchmarks.needed_leds` prints, for AFIT's SimSat within 30 degrees of tilt, how many LEDs a field sees, the
part of the attitudes with fewer than two, and the error of an attitude at 0.1 px, as `benchmarks.placement` has it.
"""

from __future__ import annotations

from benchmarks.placement import build_setup, leds, sigmas_arcsec, summarize

COUNTS = (200, 300, 350, 400, 500, 700, 1000, 1400)


def main() -> None:
    setup = build_setup()
    heads = ("LEDs", "seen (min)", "fewer than two", "roll: median, worst 1 %", "cross: median, worst 1 %")
    print(f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}")
    for count in COUNTS:
        place_m, _ = leds(setup, "Fibonacci", count, 1)
        roll, cross, seen = sigmas_arcsec(setup, place_m)
        errors = [f"{summarize(one)[0]:.3g}″, {summarize(one)[1]:.3g}″" for one in (roll, cross)]
        blind = (seen < 2).mean()
        print(
            f"| {count:,} | {seen.mean():.1f} ({seen.min():.0f}) | {blind:.2%} | {errors[0]} | {errors[1]} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
