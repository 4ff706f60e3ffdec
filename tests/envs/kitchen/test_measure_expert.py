from __future__ import annotations

import pytest

from torchrl_caiac.envs.kitchen.measure_expert import main
from torchrl_caiac.envs.kitchen.waypoints import TASKS


def test_tasks_and_chains_are_measured(caplog, capsys):
    with caplog.at_level("INFO"):
        code = main(["--task", "all", "--episodes", "1"])
    assert code == 0
    for name in TASKS:
        assert f"{name}: 1 of 1 episodes" in caplog.text
    with caplog.at_level("INFO"):
        code = main(["--chain", "2", "--episodes", "1", "--random-start", "--verbose"])
    assert code == 0
    assert "chains of 2: 1 of 1" in caplog.text
    with pytest.raises(SystemExit):
        main(["--task", "kettle", "--episodes", "0"])
    assert "--episodes is 0" in capsys.readouterr().err
