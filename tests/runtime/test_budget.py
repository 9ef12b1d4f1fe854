import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.budgeting.model_choice import Candidate, choose

INT8 = Candidate("stsr-int8", 35.20, 813.0, 1119.0)
FLOAT = Candidate("stsr", 35.27, 1056.0, 1398.0)
WORSE = Candidate("mtsr2-int8", 35.15, 936.0, 1230.0)

CANDIDATES = st.lists(
    st.builds(
        lambda number, psnr_db, p50_us, more_us: Candidate(f"m{number}", psnr_db, p50_us, p50_us + more_us),
        st.integers(0, 99),
        st.sampled_from([30.0, 31.0, 32.0, 33.0]) | st.floats(20, 40),
        st.sampled_from([500.0, 600.0, 700.0]) | st.floats(1, 5000),
        st.floats(0, 5000, allow_subnormal=False),  # onnxruntime, in a test before, made them zero
    ),
    min_size=1,
    max_size=8,
)


@pytest.mark.parametrize(
    ("budget_us", "name", "fits", "why"),
    [
        (1398, "stsr", True, "budget 1398 us: stsr (35.27 dB, p99 1398 us) fits, the least error of 3"),
        (
            1397.5,
            "stsr-int8",
            True,
            "budget 1397.5 us: stsr-int8 (35.20 dB, p99 1119 us) is the least error that fits; "
            "stsr (35.27 dB, p99 1398 us) does not",
        ),
        (
            1118,
            "stsr-int8",
            False,
            "budget 1118 us: no model fits, stsr-int8 (35.20 dB, p99 1119 us) is the fastest of 3: "
            "patterns will be late",
        ),
    ],
)
def test_the_least_error_that_fits_is_chosen_and_it_says_why(budget_us, name, fits, why):
    choice = choose([FLOAT, WORSE, INT8], budget_us)
    assert (choice.name, choice.fits, choice.why) == (name, fits, why)


def test_where_nothing_fits_a_hiccup_in_the_calibration_does_not_hide_the_fastest():
    hiccup = Candidate("stsr-int8", 35.20, 813.0, 9000.0)
    assert choose([FLOAT, hiccup], 1000).name == "stsr-int8"
    assert choose([FLOAT, hiccup], 2000).name == "stsr"


def test_of_two_as_fast_the_better_is_chosen_and_of_two_as_good_the_faster():
    better, slower = Candidate("b", 36.0, 813.0, 1119.0), Candidate("s", 36.0, 900.0, 1000.0)
    assert choose([INT8, slower, better], 2000).name == "b"
    assert choose([INT8, better], 1).name == "b"


def test_nothing_to_choose_from():
    with pytest.raises(ValueError, match=r"no candidates"):
        choose([], 1000)


@given(CANDIDATES, st.floats(1, 12000))
def test_no_candidate_betters_the_choice(candidates, budget_us):
    choice = choose(candidates, budget_us)
    fitting = [one for one in candidates if one.p99_us <= budget_us]
    assert choice.fits == bool(fitting)
    if fitting:
        wanted = min(fitting, key=lambda one: (-one.psnr_db, one.p50_us))
    else:
        wanted = min(candidates, key=lambda one: (one.p50_us, -one.psnr_db))
    same = [one for one in candidates if (one.psnr_db, one.p50_us) == (wanted.psnr_db, wanted.p50_us)]
    assert choice.name in {one.name for one in same}
