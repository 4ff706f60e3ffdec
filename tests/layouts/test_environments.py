"""Ready layouts are proved in the simulators: what moves is what changes.

Every degree of freedom of every entity is moved, or given a velocity, alone. Only
columns of this entity may change, or columns that belong to no entity; and every column
of the entity must change once.
"""

from __future__ import annotations

import functools
import logging
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_caiac.envs import FetchPushCubes, KitchenEnv, fetch_push_layout
from torchrl_caiac.envs.kitchen.tasks import STATE_COLUMNS
from torchrl_caiac.layouts import layout_names, matching_layouts, ready_layout
from torchrl_caiac.layouts.description import MILLIMETRE, MILLIRADIAN, TURN
from torchrl_caiac.layouts.ready import describe_layout

NOTHING = 1e-6  # observations of some environments are float32


@dataclass
class Simulator:
    """An environment whose joints can be moved one by one."""

    model: Any
    data: Any
    observe: Callable[[], np.ndarray]  # without a step
    joints: dict[str, list[int]]  # of each entity
    step: float  # seconds
    size: float = MILLIMETRE  # of motions, in metres or, of joints, radians
    turn: float = TURN  # of loose objects, in radians
    # Changes that no joint makes; each context puts everything back.
    moves: dict[str, list[Callable[[], Any]]] = field(default_factory=dict)  # by size
    changes: dict[str, list[Callable[[], Any]]] = field(default_factory=dict)  # larger
    # Columns that nothing changes here.
    still: dict[str, set[int]] = field(default_factory=dict)
    goal: np.ndarray | None = None
    sample: Callable[[], np.ndarray] | None = None  # observations of an episode
    observe_once: Callable[[], np.ndarray] | None = None  # if a second one differs


def joints(model: Any, entities: dict[str, tuple[str, ...]]) -> dict[str, list[int]]:
    """The joints with the names of each entity, or that go on without a digit."""
    names = [model.joint(i).name for i in range(model.njnt)]
    return {
        entity: [
            i
            for i, name in enumerate(names)
            if starts and re.match(rf"({'|'.join(starts)})(?!\d)", name)
        ]
        for entity, starts in entities.items()
    }


@contextmanager
def moved(values: Any, where: Any, to: Any) -> Iterator[None]:
    before = values[where].copy()
    values[where] = to
    yield
    values[where] = before


def shifts(values: Any, size: float = MILLIMETRE) -> list[Callable[[], Any]]:
    """Changes of each of three coordinates."""
    return [functools.partial(moved, values, i, values[i] + size) for i in range(3)]


def episode(env: Any, read: Callable[[Any], np.ndarray]) -> Callable[[], np.ndarray]:
    def sample() -> np.ndarray:
        np.random.seed(0)  # OGBench draws its tasks from it
        env.reset(seed=0)
        env.action_space.seed(0)
        steps = [env.step(env.action_space.sample())[0] for _ in range(20)]
        return np.stack([read(observation) for observation in steps])

    return sample


# --- the environments ---------------------------------------------------------------


def ogbench(name: str) -> Simulator:
    import ogbench  # noqa: F401  # it registers the environments

    env: Any = gymnasium.make(f"{name}-v0").unwrapped
    env.reset(seed=0)
    model, data = env._model, env._data
    layout = ready_layout(f"ogbench/{name}")
    names = {"robot": ("ur5e",), "drawer": ("drawer",), "window": ("window",)}
    for entity in layout.names:
        kind, number = re.fullmatch(r"(\D+)(\d*)", entity).groups()
        if number:
            prefix = "object" if kind == "cube" else "buttonbox"
            names[entity] = (f"{prefix}_joint_{number}",)

    @contextmanager
    def pressed(button: int) -> Iterator[None]:
        env._cur_button_states[button] ^= 1
        yield
        env._cur_button_states[button] ^= 1

    @contextmanager
    def touched() -> Iterator[None]:
        forces = data.body("ur5e/robotiq/right_pad").cfrc_ext
        with moved(forces, slice(None), np.array([0, 0, 0, 1.0, 0, 0])):
            yield

    buttons = [n for n in layout.names if n.startswith("button")]
    changes: dict[str, Any] = {
        n: [functools.partial(pressed, i)] for i, n in enumerate(buttons)
    }
    return Simulator(
        model,
        data,
        env.compute_observation,
        joints(model, {n: names[n] for n in layout.names}),
        env._control_timestep,
        changes={"robot": [touched], **changes},
        goal=env.compute_oracle_observation(),
        sample=episode(env, np.asarray),
    )


def fetch(name: str) -> Simulator:
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    env: Any = gymnasium.make(f"{name}-v4").unwrapped
    observation, _ = env.reset(seed=0)
    return Simulator(
        env.model,
        env.data,
        lambda: env._get_obs()["observation"],
        joints(env.model, {"gripper": ("robot0",), "object": ("object0",)}),
        env.dt,
        goal=observation["achieved_goal"],
        sample=episode(env, lambda observation: observation["observation"]),
    )


def fetch_push_cubes(count: int) -> Simulator:
    env = FetchPushCubes(count)
    observation, _ = env.reset(seed=0)
    names = {"gripper": ("robot0",)}
    names |= {f"cube{i}": (f"object{i}",) for i in range(count)}
    return Simulator(
        env.model,
        env.data,
        lambda: env._observe()["observation"].astype(np.float64),
        joints(env.model, names),
        env.dt,
        turn=MILLIRADIAN,
        goal=observation["achieved_goal"],
        sample=episode(env, lambda observation: observation["observation"]),
    )


def kitchen() -> Simulator:
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    env: Any = gymnasium.make(
        "FrankaKitchen-v1", robot_noise_ratio=0.0, object_noise_ratio=0.0
    ).unwrapped
    env.reset(seed=0)
    robot = env.robot_env
    mujoco.mju_normalize4(robot.data.qpos[-4:])  # of the kettle; upstream's is not
    names = {
        "robot": ("robot:",),
        "bottom_right_burner": ("knob_Joint_1", "bottom_right_burner"),
        "bottom_burner": ("knob_Joint_2", "bottom_left_burner"),
        "top_right_burner": ("knob_Joint_3", "top_right_burner"),
        "top_burner": ("knob_Joint_4", "top_left_burner"),
        "light_switch": ("light",),
        "slide_cabinet": ("slide_cabinet",),
        "hinge_cabinet": ("left_hinge", "right_hinge"),
        "microwave": ("microwave",),
        "kettle": ("kettle",),
    }
    return Simulator(
        robot.model,
        robot.data,
        lambda: env._get_obs(robot._get_obs())["observation"],
        joints(robot.model, names),
        robot.dt,
        size=2 * MILLIMETRE,
        turn=2 * MILLIRADIAN,
        goal=robot.data.qpos[9:30].copy(),
        sample=episode(env, lambda observation: observation["observation"]),
    )


def adroit(name: str) -> Simulator:
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    env: Any = gymnasium.make(f"AdroitHand{name}-v1").unwrapped
    env.reset(seed=0)
    model = env.model
    others = {
        "Door": {"door": ("door_hinge", "latch")},
        "Hammer": {"nail": ("nail_dir",), "hammer": ("OBJ",)},
        "Pen": {"pen": ("OBJ",), "target": ()},
        "Relocate": {},
    }[name]
    hand = ("AR", "WR", "FF", "MF", "RF", "LF", "TH")
    found = joints(model, {"hand": hand, **others})
    moves: dict[str, Any] = {}
    changes: dict[str, Any] = {}
    if name == "Door":
        hinge = model.joint("door_hinge").qposadr[0]
        moves["door"] = shifts(model.body_pos[env.door_body_id])
        changes["door"] = [functools.partial(moved, env.data.qpos, hinge, 1.5)]
    if name == "Hammer":
        sensor = env._model_names.sensor_name2id["S_nail"]
        moves["nail"] = shifts(model.body_pos[env.target_body_id])
        changes["nail"] = [functools.partial(moved, env.data.sensordata, sensor, 0.5)]
    if name == "Pen":
        env.data.qpos[-3:] = 0.3, 0.4, 0.5
        mujoco.mj_forward(model, env.data)
        quaternion = model.body_quat[env.target_obj_body_id]
        for axis in np.eye(3):
            turned = quaternion.copy()
            mujoco.mju_quatIntegrate(turned, axis, TURN)
            turn = functools.partial(moved, quaternion, slice(None), turned)
            moves.setdefault("target", []).append(turn)
    return Simulator(
        model,
        env.data,
        env._get_obs,
        found,
        5 * env.dt,
        moves=moves,
        changes=changes,
        sample=episode(env, np.asarray),
    )


def metaworld(name: str) -> Simulator:
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE as TASKS

    env: Any = TASKS[f"{name}-v3-goal-observable"](seed=0)
    env.reset()
    model, data = env.model, env.data

    def observe() -> np.ndarray:
        env._get_obs()  # the next one has this frame as the previous
        return env._get_obs()

    hand = joints(model, {"hand": (r"right_j\d", "r_close", "l_close")})["hand"]
    rest = [i for i in range(model.njnt) if i not in hand]
    claw = functools.partial(moved, data.qpos, model.joint("r_close").qposadr[0], 0.03)
    moves: dict[str, Any] = {"goal": shifts(env._target_pos)}
    if name == "hammer":
        found = {"hand": hand, "object0": [rest[0]], "object1": [rest[1]], "goal": []}
        box = model.body_pos[model.body("box").id]
        moves["object1"] = shifts(box)
        still = {"object1": {*range(14, 18), *range(32, 36)}}
    else:
        found, still = {"hand": hand, "object": rest, "goal": []}, {}
    return Simulator(
        model,
        data,
        observe,
        found,
        env.dt,
        moves=moves,
        changes={"hand": [claw]},
        still=still,
        sample=episode(env, np.asarray),
        observe_once=env._get_obs,
    )


@contextmanager
def robosuite_on_this_mujoco() -> Iterator[None]:
    """robosuite 1.5.1 computes inertias of its controllers as older MuJoCo did."""
    from robosuite.utils import binding_utils
    from robosuite.utils.log_utils import ROBOSUITE_DEFAULT_LOGGER

    def inertia(model: Any, out: np.ndarray, matrix: Any) -> None:
        np.copyto(out, np.eye(len(out)))  # only controllers read it, and none acts

    ROBOSUITE_DEFAULT_LOGGER.setLevel(logging.ERROR)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mujoco, "mj_fullM", inertia)
        patch.setattr(binding_utils.MjData, "qM", None, raising=False)
        yield


def robosuite(name: str) -> Simulator:
    logging.disable(logging.WARNING)  # it warns at import
    import robosuite

    logging.disable(logging.NOTSET)
    with robosuite_on_this_mujoco():
        env = robosuite.make(
            name,
            robots="Panda",
            has_renderer=False,
            has_offscreen_renderer=False,
            use_camera_obs=False,
            control_freq=20,
        )
        env.reset()
    data = env.sim.data._data

    def observe() -> np.ndarray:
        for observable in env._observables.values():
            observable.reset()
        seen = env._get_observations(force_update=True)
        keys = ("object-state", "robot0_eef_pos", "robot0_eef_quat")
        return np.concatenate([seen[k] for k in (*keys, "robot0_gripper_qpos")])

    entities = {
        "Lift": {"cube": ("cube",)},
        "Stack": {"cubeA": ("cubeA",), "cubeB": ("cubeB",)},
        "PickPlaceCan": {"can": ("Can",)},
        "NutAssemblySquare": {"nut": ("SquareNut",)},
    }[name]
    model = env.sim.model._model
    found = joints(model, {"robot": ("robot0", "gripper0"), **entities})

    def sample() -> np.ndarray:
        states = []
        for seed in range(10):
            generator = np.random.default_rng(seed)
            with moved(data.qpos, slice(7), generator.uniform(-1, 1, 7)):
                mujoco.mj_forward(model, data)
                states.append(observe())
        return np.stack(states)

    return Simulator(model, data, observe, found, env.control_timestep, sample=sample)


SIMULATORS: dict[str, Callable[[], Simulator]] = {
    "ogbench/cube-single": functools.partial(ogbench, "cube-single"),
    "ogbench/cube-double": functools.partial(ogbench, "cube-double"),
    "ogbench/cube-triple": functools.partial(ogbench, "cube-triple"),
    "ogbench/cube-quadruple": functools.partial(ogbench, "cube-quadruple"),
    "ogbench/scene": functools.partial(ogbench, "scene"),
    "ogbench/puzzle-3x3": functools.partial(ogbench, "puzzle-3x3"),
    "ogbench/puzzle-4x4": functools.partial(ogbench, "puzzle-4x4"),
    "ogbench/puzzle-4x5": functools.partial(ogbench, "puzzle-4x5"),
    "ogbench/puzzle-4x6": functools.partial(ogbench, "puzzle-4x6"),
    "fetch/reach": functools.partial(fetch, "FetchReach"),
    "fetch/push": functools.partial(fetch, "FetchPush"),
    "fetch/slide": functools.partial(fetch, "FetchSlide"),
    "fetch/pick-and-place": functools.partial(fetch, "FetchPickAndPlace"),
    "fetch_push_cubes/2": functools.partial(fetch_push_cubes, 2),
    "kitchen/franka": kitchen,
    "adroit/door": functools.partial(adroit, "Door"),
    "adroit/hammer": functools.partial(adroit, "Hammer"),
    "adroit/pen": functools.partial(adroit, "Pen"),
    "adroit/relocate": functools.partial(adroit, "Relocate"),
    "robosuite/lift-flat": functools.partial(robosuite, "Lift"),
    "robosuite/stack-flat": functools.partial(robosuite, "Stack"),
    "robosuite/can-flat": functools.partial(robosuite, "PickPlaceCan"),
    "robosuite/square-flat": functools.partial(robosuite, "NutAssemblySquare"),
    "metaworld/one-object": functools.partial(metaworld, "push"),
    "metaworld/two-objects": functools.partial(metaworld, "hammer"),
}


@pytest.fixture(scope="module", params=sorted(SIMULATORS))
def named(request: pytest.FixtureRequest) -> tuple[str, Simulator]:
    return request.param, SIMULATORS[request.param]()


# --- moving one thing ---------------------------------------------------------------


def size_of(simulator: Simulator, joint: int, axis: int) -> float:
    """A motion that is just noise."""
    model = simulator.model
    is_free = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE
    # Adroit has slides and hinges instead of free joints.
    is_turn = (is_free and axis >= 3) or model.joint(joint).name.startswith("OBJR")
    return simulator.turn if is_turn else simulator.size


def small_changes(simulator: Simulator, entity: str) -> Iterator[np.ndarray]:
    """The change of the observation for each small motion of an entity."""
    model, data, observe = simulator.model, simulator.data, simulator.observe
    mujoco.mj_forward(model, data)
    observe()
    before = observe()
    for joint in simulator.joints[entity]:
        first, place = model.jnt_dofadr[joint], model.jnt_qposadr[joint]
        is_free = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE
        for axis in range(6 if is_free else 1):
            size = size_of(simulator, joint, axis)
            unit = np.eye(model.nv)[first + axis]
            positions = data.qpos.copy()
            mujoco.mj_integratePos(model, positions, unit, size)
            own = slice(place, place + (7 if is_free else 1))
            speeds = data.qvel + unit * size / simulator.step
            for values, where, to in (
                (data.qpos, own, positions[own]),
                (data.qvel, slice(None), speeds),
            ):
                with moved(values, where, to):
                    mujoco.mj_forward(model, data)
                    yield observe() - before
    for change in simulator.moves.get(entity, ()):
        with change():
            mujoco.mj_forward(model, data)
            yield observe() - before
    mujoco.mj_forward(model, data)


def large_changes(simulator: Simulator, entity: str) -> Iterator[np.ndarray]:
    """The same for whatever does not change by small motions."""
    before = simulator.observe()
    for change in simulator.changes.get(entity, ()):
        with change():
            # Forces and sensors keep the values that were given to them.
            mujoco.mj_kinematics(simulator.model, simulator.data)
            yield simulator.observe() - before
        mujoco.mj_forward(simulator.model, simulator.data)


def test_what_moves_is_what_changes(named: tuple[str, Simulator]) -> None:
    name, simulator = named
    layout, description = ready_layout(name), describe_layout(name)
    assert len(simulator.observe()) == layout.width
    assert set(simulator.joints) >= set(layout.names)
    for entity in layout.names:
        differences = [*small_changes(simulator, entity)]
        differences += large_changes(simulator, entity)
        changed = {
            int(c) for d in differences for c in np.flatnonzero(np.abs(d) > NOTHING)
        }
        own = set(layout.columns[entity])
        assert changed - own <= set(description.unowned), entity
        assert own - changed == simulator.still.get(entity, set()), entity


def test_floors_are_small_motions(named: tuple[str, Simulator]) -> None:
    name, simulator = named
    layout, description = ready_layout(name), describe_layout(name)
    differences = {n: [*small_changes(simulator, n)] for n in layout.names}
    checked = 0
    for part, place in description.places:
        if part.entity is None or not differences[part.entity]:
            continue
        size = max(np.linalg.norm(d[list(place)]) for d in differences[part.entity])
        if size < NOTHING:
            continue  # states and forces
        checked += 1
        if part.what.startswith(("position", "velocity")):
            assert size == pytest.approx(part.floor, rel=1e-3), part
        elif part.entity in layout.fixed or part.entity == "door":
            assert size < 2 * part.floor, part  # an end moves with every joint
        else:
            assert 0.4 * part.floor < size < 1.05 * part.floor, part
    assert checked >= len(layout)


def test_goals_mirror_the_columns(named: tuple[str, Simulator]) -> None:
    name, simulator = named
    layout = ready_layout(name)
    assert bool(layout.goal) == (simulator.goal is not None)
    if simulator.goal is not None:
        mirrored = simulator.observe()[list(layout.goal_columns())]
        np.testing.assert_allclose(mirrored, simulator.goal, atol=1e-6)


def test_data_of_the_environment_match(named: tuple[str, Simulator]) -> None:
    name, simulator = named
    assert simulator.sample is not None
    rows = torch.as_tensor(simulator.sample(), dtype=torch.float32)
    matching = matching_layouts(TensorDict({"observation": rows}, [len(rows)]))
    assert set(matching) == {n for n in layout_names() if meaning(n) == meaning(name)}


@pytest.mark.parametrize(
    ("task", "count"), [("drawer-open", "one-object"), ("stick-push", "two-objects")]
)
@pytest.mark.parametrize("goal", ["observable", "hidden"])
def test_data_of_metaworld_match(task: str, count: str, goal: str) -> None:
    import metaworld.env_dict

    tasks = getattr(metaworld.env_dict, f"ALL_V3_ENVIRONMENTS_GOAL_{goal.upper()}")
    env = tasks[f"{task}-v3-goal-{goal}"](seed=0)
    rows = torch.as_tensor(episode(env, np.asarray)())
    found = matching_layouts(TensorDict({"observation": rows}, [len(rows)]))
    assert found == [f"metaworld/{count}"]


def meaning(name: str) -> list[Any]:
    """What tells data of a layout from others."""
    return [replace(c, entity=None, what="") for c in describe_layout(name).columns]


def test_kitchen_states_are_columns_of_the_observation() -> None:
    state, whole = ready_layout("kitchen/positions"), ready_layout("kitchen/franka")
    assert state == KitchenEnv.layout
    for name in state.names:
        columns = tuple(STATE_COLUMNS[c] for c in state.columns[name])
        assert columns == whole.columns[name][: len(columns)]
        assert state.goal.get(name) == whole.goal.get(name)


def test_kitchen_floors_are_above_the_noise() -> None:
    env: Any = gymnasium.make("FrankaKitchen-v1").unwrapped
    env.reset(seed=0)
    seen = np.stack(
        [env._get_obs(env.robot_env._get_obs())["observation"] for _ in range(100)]
    )
    layout = ready_layout("kitchen/franka")
    for name in layout.names:
        columns = list(layout.columns[name])
        assert (seen[:, columns].std(0) < layout.variance_floor[name]).all(), name


def test_the_first_frame_of_metaworld_is_now() -> None:
    simulator = metaworld("push")
    before = simulator.observe()
    simulator.data.qpos[simulator.model.jnt_qposadr[simulator.joints["object"][0]]] += 1
    mujoco.mj_forward(simulator.model, simulator.data)
    assert simulator.observe_once is not None
    changed = np.flatnonzero(np.abs(simulator.observe_once() - before) > 0.5)
    layout = ready_layout("metaworld/one-object")
    assert changed.tolist() == [layout.positions["object"][0]]


def test_fetch_push_layouts_are_those_of_the_environment() -> None:
    for count in (1, 2, 3, 4):
        assert ready_layout(f"fetch_push_cubes/{count}") == fetch_push_layout(count)


@pytest.mark.parametrize("task", ["lift", "stack", "can", "square"])
def test_the_entry_of_robomimic_comes_first(task: str) -> None:
    entry, flat = (ready_layout(f"robosuite/{task}{end}") for end in ("", "-flat"))
    assert entry.observation_key == ("observation", "object")
    for name in entry.names:
        assert entry.columns[name] == flat.columns[name]
    assert set(flat.names) - set(entry.names) == {"robot"}
