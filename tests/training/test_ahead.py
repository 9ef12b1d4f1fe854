import threading

import pytest

from train.learning.prefetch import drawn_ahead

ENOUGH_S = 20


def test_every_number_once_in_order_and_none_beyond_the_end():
    drawn = []

    def batch(number):
        drawn.append(number)
        return -number

    assert list(drawn_ahead(batch, 3, 7)) == [-3, -4, -5, -6]
    assert drawn == [3, 4, 5, 6]
    assert list(drawn_ahead(batch, 7, 7)) == []


def test_the_next_is_drawn_while_one_is_used():
    drawn = [threading.Event() for _ in range(3)]

    def batch(number):
        drawn[number].set()
        return number

    batches = drawn_ahead(batch, 0, 3)
    assert next(batches) == 0
    assert drawn[1].wait(ENOUGH_S) and not drawn[2].is_set()
    batches.close()
    assert not drawn[2].is_set()


def test_what_fails_fails_at_its_number_and_leaves_no_thread():
    def batch(number):
        if number == 2:
            raise OSError("no such batch")
        return number

    batches = drawn_ahead(batch, 0, 4)
    assert [next(batches), next(batches)] == [0, 1]
    with pytest.raises(OSError, match="no such batch"):
        next(batches)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("batches")]
