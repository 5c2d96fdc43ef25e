"""What a node shows does not hang on doubles: with single precision it says the same to the last digit of a PDO."""

import random

from micropython.single_precision import compare


def test_the_contact_pdo_differs_by_one_unit_at_most() -> None:
    chance = random.Random(20250131)
    loads = [
        (10.0 ** chance.uniform(-1.5, 1.4), chance.uniform(-60.0, 60.0), chance.uniform(-60.0, 60.0))
        for _ in range(1000)
    ]
    found = compare(loads)
    assert found.P <= 1
    assert found.phi <= 1
    assert found.theta <= 1
    assert found.status == 0
    assert found.changed <= 20, found
