import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.budgeting.model_choice import Candidate, choose, ladder_of

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
    assert choice.ladder == (INT8, FLOAT), "a rung both slower and worse is none"
    assert (choice.ladder[choice.rung].name, choice.fits, choice.why) == (name, fits, why)


def test_a_hiccup_in_the_calibration_takes_no_rung_away():
    hiccup = Candidate("stsr-int8", 35.20, 813.0, 9000.0)
    assert ladder_of([FLOAT, hiccup]) == (hiccup, FLOAT)
    assert choose([FLOAT, hiccup], 2000).rung == 1


def test_of_two_as_fast_the_better_stays_and_of_two_as_good_the_faster():
    better, slower = Candidate("b", 36.0, 813.0, 1119.0), Candidate("s", 36.0, 900.0, 1000.0)
    assert ladder_of([INT8, slower, better]) == (better,)


def test_nothing_to_choose_from():
    with pytest.raises(ValueError, match=r"no candidates"):
        choose([], 1000)


@given(CANDIDATES, st.floats(1, 12000))
def test_no_candidate_betters_the_ladder_or_the_choice(candidates, budget_us):
    choice = choose(candidates, budget_us)
    ladder = choice.ladder
    for below, above in itertools.pairwise(ladder):
        assert below.p50_us < above.p50_us and below.psnr_db < above.psnr_db
    for candidate in candidates:
        assert any(rung.p50_us <= candidate.p50_us and rung.psnr_db >= candidate.psnr_db for rung in ladder)
    chosen = ladder[choice.rung]
    fitting = [rung.psnr_db for rung in ladder if rung.p99_us <= budget_us]
    assert choice.fits == bool(fitting)
    assert chosen.psnr_db == max(fitting) if fitting else chosen == ladder[0]
