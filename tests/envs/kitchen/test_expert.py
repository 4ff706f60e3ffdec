"""The expert in the real simulator."""

from __future__ import annotations

import dataclasses

import gymnasium
import gymnasium_robotics
import numpy as np
import pytest
from gymnasium_robotics.envs.franka_kitchen.kitchen_env import (
    OBS_ELEMENT_GOALS,
    OBS_ELEMENT_INDICES,
)

from torchrl_caiac.envs.kitchen import expert
from torchrl_caiac.envs.kitchen.env import KitchenEnv
from torchrl_caiac.envs.kitchen.expert import (
    TASKS,
    KitchenChain,
    KitchenExpert,
    Waypoint,
    random_chain_start,
    set_kitchen_start,
    tool_rotation,
)


@pytest.fixture(scope="module")
def env():
    gymnasium.register_envs(gymnasium_robotics)
    env = gymnasium.make(
        "FrankaKitchen-v1",
        tasks_to_complete=["microwave", "kettle"],
        terminate_on_tasks_completed=False,
        max_episode_steps=2000,
        disable_env_checker=True,
    )
    yield env
    env.close()


def play(env, expert, seed, cabinet=0.0, steps=80):
    env.reset(seed=seed)
    set_kitchen_start(env, {"slide_cabinet": cabinet})
    expert.rng = np.random.default_rng(seed)
    expert.reset()
    begin = expert.data.qpos.copy()
    actions = []
    for _ in range(steps):
        actions.append(expert())
        env.step(actions[-1])
        if expert.goal_distance < 0.25:
            break
    return np.stack(actions), begin, expert.data.qpos.copy()


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("cabinet", [0.0, 0.37])
def test_solves_its_task_and_touches_nothing_else(env, task, cabinet):
    if task == "slide cabinet":
        cabinet /= 10  # it starts ajar: more would be solved
    expert = KitchenExpert(env, task)
    for seed in (1, 2):
        actions, begin, end = play(env, expert, seed, cabinet)
        assert expert.success
        assert np.abs(actions).max() <= 1
        others = np.setdiff1d(np.arange(9, 30), expert.task.columns)
        assert np.abs(end - begin)[others].max() < 0.02
        if task != "slide cabinet":
            assert end[19] == pytest.approx(cabinet, abs=0.01)


@pytest.mark.parametrize("speed", [0.35, 1.4])
@pytest.mark.parametrize("task", TASKS)
def test_succeeds_at_other_speeds(env, task, speed):
    expert = KitchenExpert(env, task, speed=speed, speed_range=0.1)
    play(env, expert, 5, steps=150)
    assert expert.success


@pytest.mark.parametrize("name", TASKS)
def test_tables_are_well_formed(env, name):
    table = TASKS[name]
    assert table.name == name
    assert list(table.columns) == list(OBS_ELEMENT_INDICES[name])
    np.testing.assert_array_equal(table.goal, OBS_ELEMENT_GOALS[name])
    env.reset(seed=0)
    set_kitchen_start(env)
    for variant in (table, table.alternative):
        if variant is None:
            continue
        assert (variant.name, variant.columns, variant.goal) == (
            table.name,
            table.columns,
            table.goal,
        )
        expert = KitchenExpert(env, variant, waypoint_noise=0, rng=0)
        assert expert.goal_distance > 0.3
        posture = np.array(variant.posture)
        low, high = expert.ik.limits.T
        assert ((posture >= low - 1e-9) & (posture <= high + 1e-9)).all()
        configuration = expert.data.qpos.copy()
        configuration[:7] = posture
        assert not expert.ik.in_collision(configuration)
        first = variant.waypoints[0]
        assert first.move == "reach"
        reached = expert.ik.solve(
            configuration,
            expert._anchor(first) + first.offset,
            expert._rotation(dataclasses.replace(first, lead=0.0)),
            iterations=30,
        )
        assert reached.position_error < 5e-3
        assert reached.rotation_error < 0.05
        for waypoint in variant.waypoints:
            if waypoint.until is not None:
                joint = env.unwrapped.robot_env.model.joint(waypoint.joint)
                assert joint.qposadr[0] in variant.columns
                at = variant.columns.index(joint.qposadr[0])
                assert abs(waypoint.until - variant.goal[at]) < 0.1
                assert waypoint.lead * variant.goal[at] > 0
        whole = variant.with_retreat()
        assert whole.waypoints[: len(variant.waypoints)] == variant.waypoints
        stages = whole.waypoints[len(variant.waypoints) :]
        assert stages and {stage.move for stage in stages} == {"back"}
        assert {stage.gripper for stage in stages} == {first.gripper}


def test_a_grasp_turns_with_its_knob(env):
    env.reset(seed=0)
    set_kitchen_start(env, {"knob_Joint_2": -0.4})
    expert = KitchenExpert(env, "bottom burner", rng=0)
    waypoint = dataclasses.replace(expert.task.waypoints[0], lead=0.0)
    straight = tool_rotation(waypoint.yaw, waypoint.pitch)
    turn = expert._rotation(waypoint) @ straight.T
    axis = expert.data.joint("knob_Joint_2").xaxis
    np.testing.assert_allclose(turn @ axis, axis, atol=1e-9)
    assert np.arccos((np.trace(turn) - 1) / 2) == pytest.approx(0.4)
    for _ in range(60):
        if not expert._targets:
            expert.reset()
        env.step(expert())
        if expert.success:
            break
    assert expert.success


def begin_chain(env, tasks, seed, positions=None, **kwargs):
    env.reset(seed=seed)
    set_kitchen_start(env, positions)
    chain = KitchenChain(env, tasks, rng=seed, **kwargs)
    chain.reset()
    return chain


def run_chain(env, chain, meddle=lambda step: None, steps=900):
    played = []
    for step in range(steps):
        action = chain()
        assert np.abs(action).max() <= 1
        if chain.finished:
            break
        played.append((chain.task, chain.attempts[chain.task]))
        env.step(action)
        meddle(step)
    return list(dict.fromkeys(played))


@pytest.mark.parametrize(
    ("tasks", "seed"),
    [
        (("microwave", "kettle", "light switch", "slide cabinet"), 0),
        (("hinge cabinet", "slide cabinet", "bottom burner", "microwave"), 1),
        (("top burner", "hinge cabinet", "kettle", "light switch"), 2),
    ],
)
def test_chains_of_four(env, tasks, seed):
    chain = begin_chain(env, tasks, seed, speed_range=0.4)
    played = run_chain(env, chain)
    assert chain.finished
    assert chain.success
    assert chain.wrong_tasks == ()
    assert set(tasks) == set(chain.solved)
    assert [name for name, attempt in played if attempt == 1] == list(tasks)
    # Whoever acts on holds still.
    hand, _ = chain.expert.ik.pose(chain.expert.data.qpos)
    for _ in range(5):
        env.step(chain())
    after, _ = chain.expert.ik.pose(chain.expert.data.qpos)
    assert np.linalg.norm(after - hand) < 0.03


def test_chain_from_a_random_start(env):
    kitchen = KitchenEnv()
    tasks = ["light switch", "microwave", "kettle", "bottom burner"]
    env.reset(seed=3)
    start = random_chain_start(kitchen, tasks, rng=np.random.default_rng(3))
    set_kitchen_start(env, qpos=start)
    chain = KitchenChain(env, tasks, rng=3)
    chain.reset()
    run_chain(env, chain)
    assert chain.success


def test_a_failed_task_is_tried_again(env):
    chain = begin_chain(env, ["slide cabinet"], 0)
    model = chain.expert.model
    column = model.joint("slide_cabinet").qposadr[0]
    meddled = []

    def close(step):
        if chain.expert.success and len(meddled) < 1:
            meddled.append(step)
            qpos = chain.expert.data.qpos.copy()
            qpos[column] = 0.0
            set_kitchen_start(env, qpos=qpos)

    # The hand is past the handle by then: this attempt moves it no more.
    first = run_chain(env, chain, close)
    assert meddled
    assert first == [("slide cabinet", 1), ("slide cabinet", 2)]
    assert chain.success
    meddled.clear()
    chain = begin_chain(env, ["slide cabinet"], 0, retries=0)
    assert run_chain(env, chain, close) == [("slide cabinet", 1)]
    assert chain.finished
    assert not chain.success


def test_an_undone_task_is_repaired(env):
    chain = begin_chain(env, ["kettle", "light switch"], 1)
    meddled = []

    def push_back(step):
        # The hand is at the switch, out of the kettle's way.
        if "light switch" in chain.solved and not meddled:
            meddled.append(step)
            qpos = chain.expert.data.qpos.copy()
            qpos[23:30] = KitchenEnv.default_state()[23:30]
            set_kitchen_start(env, qpos=qpos)

    played = run_chain(env, chain, push_back)
    assert played == [("kettle", 1), ("light switch", 1), ("kettle", 2)]
    assert chain.success


def test_solved_tasks_are_not_played_and_wrong_ones_count(env):
    solved = {"slide_cabinet": 0.37}
    chain = begin_chain(env, ["slide cabinet", "kettle"], 0, solved)
    assert chain.solved == ("slide cabinet",)
    assert chain.task == "kettle"
    assert run_chain(env, chain) == [("kettle", 1)]
    assert chain.attempts == {"slide cabinet": 0, "kettle": 1}
    assert chain.success
    set_kitchen_start(env, {"light_switch": -0.69})
    assert chain.wrong_tasks == ("light switch",)
    assert not chain.success
    # Nothing to do: the hand stays.
    chain.reset(["slide cabinet", "light switch"])
    assert chain.finished
    assert chain.success
    before, _ = chain.expert.ik.pose(chain.expert.data.qpos)
    for _ in range(5):
        env.step(chain())
    after, _ = chain.expert.ik.pose(chain.expert.data.qpos)
    np.testing.assert_allclose(after, before, atol=0.02)


def test_a_closed_and_an_open_door_ask_for_different_tables(env):
    chain = begin_chain(env, ["slide cabinet"], 0)
    posture = chain.expert.task.posture
    assert posture == TASKS["slide cabinet"].posture
    for angle in (0.6, 1.45):
        door = {"right_hinge_cabinet": angle}
        chain = begin_chain(env, ["slide cabinet"], 0, door)
        assert chain.expert.task.posture == TASKS["slide cabinet"].alternative.posture
        run_chain(env, chain)
        assert chain.success
        assert chain.expert.data.qpos[21] == pytest.approx(angle, abs=0.01)


def test_chains_repeat_with_their_seed(env):
    def actions(seed):
        chain = begin_chain(env, ["kettle"], seed)
        taken = []
        for _ in range(20):
            taken.append(chain())
            env.step(taken[-1])
        return np.stack(taken)

    first = actions(4)
    np.testing.assert_array_equal(first, actions(4))
    assert not np.array_equal(first, actions(5))


def test_random_chain_start():
    kitchen = KitchenEnv()
    default = kitchen.default_state()
    rng = np.random.default_rng(0)
    tasks = ["hinge cabinet", "kettle", "top burner"]
    own = [column for name in tasks for column in TASKS[name].columns]
    starts = np.stack([random_chain_start(kitchen, tasks, rng=rng) for _ in range(12)])
    np.testing.assert_array_equal(starts[:, own], np.tile(default[own], (12, 1)))
    np.testing.assert_array_equal(starts[:, :9], np.tile(default[:9], (12, 1)))
    assert (starts[:, [17, 19, 22]].std(axis=0) > 0).all()
    again = random_chain_start(kitchen, tasks, rng=np.random.default_rng(0))
    np.testing.assert_array_equal(again, starts[0])
    with pytest.raises(KeyError, match="toaster"):
        random_chain_start(kitchen, ["toaster"], rng=rng)
    with pytest.raises(ValueError, match="no tasks"):
        random_chain_start(kitchen, [], rng=rng)


def test_equal_seeds_give_equal_actions_and_slower_is_longer(env):
    expert = KitchenExpert(env, "kettle", speed=1.0)
    first, _, _ = play(env, expert, 3)
    again, _, _ = play(env, expert, 3)
    np.testing.assert_array_equal(first, again)
    other, _, _ = play(env, expert, 4)
    assert not np.array_equal(first[0], other[0])
    expert.speed = 0.4
    slow, _, _ = play(env, expert, 3)
    assert len(slow) > 1.3 * len(first)


def test_works_in_kitchen_env_and_only_reads_the_simulator():
    env = KitchenEnv("kettle", terminate_on_success=False)
    try:
        env.reset(seed=0, options={"open": "slide_cabinet"})
        expert = KitchenExpert(env, "kettle", rng=0)
        expert.reset()
        for _ in range(40):
            before = (env.qpos, env.qvel, env.data.time)
            action = expert()
            np.testing.assert_array_equal(before[0], env.qpos)
            np.testing.assert_array_equal(before[1], env.qvel)
            assert before[2] == env.data.time
            *_, info = env.step(action)
        assert expert.success
        assert expert.finished
        assert info["task_success"]
    finally:
        env.close()


def test_another_task_is_another_table(env):
    table = dataclasses.replace(
        TASKS["kettle"],
        name="wave",
        posture=None,
        waypoints=(
            Waypoint("reach", (-0.35, 0.35, 2.0), gripper=0.04, tolerance=0.03),
            Waypoint("line", (-0.25, 0.4, 2.0), speed=0.5, tolerance=0.01, noisy=False),
            Waypoint("hold", (-0.25, 0.4, 2.0), steps=12, noisy=False),
        ),
    )
    env.reset(seed=0)
    set_kitchen_start(env)
    expert = KitchenExpert(env, table, action_noise=0, waypoint_noise=0, rng=0)
    expert.reset()
    stages = []
    for _ in range(60):
        action = expert()
        stages.append(expert.stage)
        if expert.finished:
            break
        env.step(action)
    assert stages == sorted(stages)
    assert set(stages) == {0, 1, 2, 3}
    point, rotation = expert.ik.pose(expert.data.qpos)
    np.testing.assert_allclose(point, (-0.25, 0.4, 2.0), atol=0.01)
    np.testing.assert_allclose(rotation, tool_rotation(), atol=0.1)
    assert expert.data.qpos[7:9].max() < 0.01


def test_tool_rotation_points_where_the_angles_say():
    right = tool_rotation(yaw=0.4)[:, 2]
    assert right[0] == pytest.approx(np.sin(0.4))
    down = tool_rotation(pitch=-0.4)[:, 2]
    assert down[2] == pytest.approx(-np.sin(0.4))
    rolled = tool_rotation(0.2, -0.3, 0.5)
    np.testing.assert_allclose(rolled @ rolled.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(rolled[:, 2], tool_rotation(0.2, -0.3)[:, 2])


def test_set_kitchen_start(env):
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.full(9, 0.5))
    observation = set_kitchen_start(
        env, {"knob_Joint_2": -0.87, "light_switch": -0.69, "slide_cabinet": 0.3}
    )
    data = env.unwrapped.robot_env.data
    assert data.qpos[11] == -0.87
    assert data.qpos[12] == pytest.approx(-0.005)
    assert data.qpos[18] == pytest.approx(-0.05)
    assert (data.qvel == 0).all()
    np.testing.assert_allclose(
        env.unwrapped.robot_env._last_robot_qpos, data.qpos[:9], atol=2e-3
    )
    np.testing.assert_allclose(
        observation["observation"][18:39], data.qpos[9:], atol=1e-3
    )
    qpos, qvel = data.qpos.copy(), np.linspace(0, 0.1, 29)
    set_kitchen_start(env, qpos=qpos, qvel=qvel)
    np.testing.assert_array_equal(data.qpos, qpos)
    np.testing.assert_array_equal(data.qvel, qvel)


def test_bad_input(env):
    env.reset(seed=0)
    with pytest.raises(KeyError, match="no expert for task 'toaster'"):
        KitchenExpert(env, "toaster")
    with pytest.raises(ValueError, match="speed is 0"):
        KitchenExpert(env, "kettle", speed=0)
    with pytest.raises(ValueError, match="speed_range is 1"):
        KitchenExpert(env, "kettle", speed_range=1)
    with pytest.raises(ValueError, match="at least 0"):
        KitchenExpert(env, "kettle", action_noise=-1)
    with pytest.raises(TypeError, match="has no simulator"):
        KitchenExpert(object(), "kettle")
    with pytest.raises(RuntimeError, match="reset"):
        KitchenExpert(env, "kettle")()
    with pytest.raises(ValueError, match="needs joint, anchor and until"):
        Waypoint("follow")
    with pytest.raises(ValueError, match="clearance is -1"):
        KitchenExpert(env, "kettle", clearance=-1)
    with pytest.raises(ValueError, match="no tasks given"):
        KitchenChain(env, [])
    with pytest.raises(KeyError, match="no expert for task 'toaster'"):
        KitchenChain(env, ["kettle", "toaster"])
    with pytest.raises(ValueError, match="each at most once"):
        KitchenChain(env, ["kettle", "kettle"])
    with pytest.raises(ValueError, match="retries is -1"):
        KitchenChain(env, ["kettle"], retries=-1)
    with pytest.raises(RuntimeError, match="reset"):
        KitchenChain(env, ["kettle"])()
    with pytest.raises(KeyError, match="toaster"):
        KitchenChain(env, ["kettle"]).reset(["toaster"])
    with pytest.raises(ValueError, match="no joint 'toaster'"):
        set_kitchen_start(env, {"toaster": 1.0})
    with pytest.raises(ValueError, match=r"qpos has shape \(3,\)"):
        set_kitchen_start(env, qpos=np.zeros(3))
    with pytest.raises(ValueError, match=r"not finite at positions \[19\]"):
        set_kitchen_start(env, {"slide_cabinet": np.nan})
    with pytest.raises(TypeError, match="KitchenEnv"):
        set_kitchen_start(gymnasium.Env())


def test_main_measures(caplog, capsys):
    with caplog.at_level("INFO"):
        code = expert.main(["--task", "all", "--episodes", "1"])
    assert code == 0
    for name in TASKS:
        assert f"{name}: 1 of 1 episodes" in caplog.text
    with caplog.at_level("INFO"):
        code = expert.main(
            ["--chain", "2", "--episodes", "1", "--random-start", "--verbose"]
        )
    assert code == 0
    assert "chains of 2: 1 of 1" in caplog.text
    with pytest.raises(SystemExit):
        expert.main(["--task", "kettle", "--episodes", "0"])
    assert "--episodes is 0" in capsys.readouterr().err
