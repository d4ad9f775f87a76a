"""Simulated drives: the same by seed, and rules that differ as they must."""

from __future__ import annotations

import numpy as np
import pytest

from zsched_lab.decisions import halls


def test_a_hall_is_fixed_by_its_seed_and_its_machines_drive_apart() -> None:
    one, same, other = halls.drives_of(7), halls.drives_of(7), halls.drives_of(8)
    assert all(np.array_equal(a.rssi_dbm, b.rssi_dbm) for a, b in zip(one, same, strict=True))
    assert not np.array_equal(one[0].rssi_dbm, other[0].rssi_dbm)
    assert not np.array_equal(one[0].rssi_dbm, one[1].rssi_dbm)
    assert len(one) == halls.MACHINES
    assert one[0].rssi_dbm.size == pytest.approx(halls.DRIVE_S / 0.2)


@pytest.mark.long
def test_a_price_trades_signal_for_calm() -> None:
    found = {row.rule: row for row in halls.rows(range(3), are_robots=True)}
    least, most = found["price 0.1 s"], found["price 0.6 s"]
    assert least.moves > most.moves > 0.0
    assert found["argmax"].moves > 3 * least.moves
    assert 0.0 < found["argmax"].under_db < most.under_db
