"""Inverse kinematics of a point on a MuJoCo robot, by damped least squares."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from torchrl_caiac.envs.kitchen.rotations import rotation_vector

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = ["IKSolution", "InverseKinematics"]


class IKSolution(NamedTuple):
    """A joint configuration and the remaining error of the tool's pose.

    Attributes:
        joints (numpy.ndarray): joint positions ``[J]`` in radians (metres for sliding
            joints).
        position_error (float): distance of the tool point to its target, in metres.
        rotation_error (float): angle between tool and target orientation, in radians
            (0 where no orientation was requested).
    """

    joints: NDArray[np.float64]
    position_error: float
    rotation_error: float


class InverseKinematics:
    """Finds joint positions that bring a tool point to a pose.

    Each iteration solves the damped least-squares problem
    ``min |W (J dq - e)|^2 + damping^2 |dq|^2``, where ``e`` contains the position error
    and the orientation error. Joints that the step would push over a limit are frozen
    there and the rest is solved again. The remaining freedom pulls the joints towards
    ``posture``.

    The solver works on its own copy of the simulation data and never changes the
    robot that it plans for.

    Args:
        model (mujoco.MjModel): the model.
        site (str): name of the site that carries the tool.
        joints (sequence of str): names of the joints that may move, each with one
            degree of freedom.

    Keyword Args:
        offset (ArrayLike): the tool point in the site's frame, ``[3]``, metres.
            Defaults to zeros.
        limits (ArrayLike, optional): lower and upper joint limits ``[J, 2]``. Defaults
            to those of the model.
        damping (float): damping of the least-squares step. Defaults to 0.03.
        rotation_weight (float): weight of one radian of orientation error relative to
            one metre. Defaults to 0.3.
        iterations (int): iterations of one solve. Defaults to 8.
        posture_gain (float): fraction of the distance to ``posture`` that an iteration
            covers in the null space. Defaults to 0.1.
        max_step (float): largest change of a joint in one iteration, radians.
            Defaults to 0.3.

    Raises:
        ValueError: unknown site or joint, joints with several degrees of freedom,
            limits of the wrong shape.

    Examples:
        >>> import mujoco, numpy as np
        >>> model = mujoco.MjModel.from_xml_string('''
        ... <mujoco><worldbody><body><joint name="a" axis="0 0 1"/>
        ...   <geom size=".1"/><body pos="1 0 0"><joint name="b" axis="0 0 1"/>
        ...   <geom size=".1"/><site name="tip" pos="1 0 0"/>
        ... </body></body></worldbody></mujoco>''')
        >>> solver = InverseKinematics(model, "tip", ["a", "b"], iterations=50)
        >>> start = np.array([0.1, 0.1])
        >>> solution = solver.solve(start, position=[1.0, 1.0, 0.0])
        >>> solution.position_error < 1e-3
        True
    """

    def __init__(
        self,
        model: Any,
        site: str,
        joints: Sequence[str],
        *,
        offset: ArrayLike = (0.0, 0.0, 0.0),
        limits: ArrayLike | None = None,
        damping: float = 0.03,
        rotation_weight: float = 0.3,
        iterations: int = 8,
        posture_gain: float = 0.1,
        max_step: float = 0.3,
    ) -> None:
        import mujoco

        self._mujoco = mujoco
        self.model = model
        self.data = mujoco.MjData(model)
        self.site = self._index(mujoco.mjtObj.mjOBJ_SITE, "site", site)
        self.body = int(model.site_bodyid[self.site])
        ids = [self._index(mujoco.mjtObj.mjOBJ_JOINT, "joint", name) for name in joints]
        single = (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE))
        for name, joint in zip(joints, ids, strict=True):
            if int(model.jnt_type[joint]) not in single:
                raise ValueError(
                    f"joint {name!r} has several degrees of freedom; give sliding or "
                    "hinge joints only"
                )
        self.qpos_index = np.array([int(model.jnt_qposadr[j]) for j in ids])
        self.dof_index = np.array([int(model.jnt_dofadr[j]) for j in ids])
        self.offset = np.asarray(offset, dtype=np.float64)
        if limits is None:
            ranges = model.jnt_range[ids].copy()
            free = ~model.jnt_limited[ids].astype(bool)
            ranges[free] = (-np.inf, np.inf)
            self.limits = ranges
        else:
            self.limits = np.array(limits, dtype=np.float64)
        if self.limits.shape != (len(ids), 2):
            raise ValueError(
                f"limits have shape {self.limits.shape}, expected {(len(ids), 2)}: one "
                "(lower, upper) row per joint"
            )
        # Bodies that the joints move: children follow their parents in the model.
        self._moved = np.zeros(model.nbody, dtype=bool)
        self._moved[model.jnt_bodyid[ids]] = True
        for body in range(1, model.nbody):
            self._moved[body] |= self._moved[model.body_parentid[body]]
        # The whole robot, with its base, which the arm is always close to.
        self._robot = np.isin(model.body_rootid, model.body_rootid[self._moved])
        self._margins: dict[float, Any] = {}
        self.damping = damping
        self.rotation_weight = rotation_weight
        self.iterations = iterations
        self.posture_gain = posture_gain
        self.max_step = max_step
        self._jacobian_position = np.zeros((3, model.nv))
        self._jacobian_rotation = np.zeros((3, model.nv))

    def _index(self, kind: Any, label: str, name: str) -> int:
        index = int(self._mujoco.mj_name2id(self.model, kind, name))
        if index < 0:
            raise ValueError(f"the model has no {label} named {name!r}")
        return index

    def pose(self, qpos: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns the pose of the tool in a configuration.

        Args:
            qpos (ArrayLike): positions of the whole model, ``[nq]``.

        Returns:
            tuple of numpy.ndarray: the tool point ``[3]`` in metres and the site's
            rotation matrix ``[3, 3]``.
        """
        self.data.qpos[:] = qpos
        self._mujoco.mj_kinematics(self.model, self.data)
        rotation = self.data.site_xmat[self.site].reshape(3, 3).copy()
        point = self.data.site_xpos[self.site] + rotation @ self.offset
        return point, rotation

    def solve(
        self,
        qpos: ArrayLike,
        position: ArrayLike,
        rotation: ArrayLike | None = None,
        *,
        posture: ArrayLike | None = None,
        iterations: int | None = None,
    ) -> IKSolution:
        """Finds joint positions that move the tool to a pose.

        Args:
            qpos (ArrayLike): positions ``[nq]`` of the whole model to start from;
                everything but the solver's joints stays unchanged.
            position (ArrayLike): target of the tool point, ``[3]``, metres, world
                frame.
            rotation (ArrayLike, optional): target rotation matrix ``[3, 3]`` of the
                site. Defaults to ``None``: free.

        Keyword Args:
            posture (ArrayLike, optional): joint positions ``[J]`` that the null space
                is pulled towards.
            iterations (int, optional): iterations of this call. Defaults to the
                solver's own.

        Returns:
            IKSolution: the joints and the remaining error.

        Raises:
            ValueError: the target is not finite.
        """
        target = np.asarray(position, dtype=np.float64)
        if target.shape != (3,) or not np.isfinite(target).all():
            raise ValueError(
                f"position is {target.tolist()}, expected three finite numbers"
            )
        orientation = None if rotation is None else np.asarray(rotation, np.float64)
        pull = None if posture is None else np.asarray(posture, dtype=np.float64)
        configuration = np.array(qpos, dtype=np.float64)
        joints = np.clip(configuration[self.qpos_index], *self.limits.T)
        for _ in range(self.iterations if iterations is None else iterations):
            configuration[self.qpos_index] = joints
            error, jacobian = self._linearise(configuration, target, orientation)
            joints = joints + self._step(joints, error, jacobian, pull)
        configuration[self.qpos_index] = joints
        point, reached = self.pose(configuration)
        angle = (
            0.0
            if orientation is None
            else float(np.linalg.norm(rotation_vector(orientation @ reached.T)))
        )
        return IKSolution(joints, float(np.linalg.norm(target - point)), angle)

    def _linearise(
        self,
        configuration: NDArray[np.float64],
        target: NDArray[np.float64],
        orientation: NDArray[np.float64] | None,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns the weighted error ``[3 or 6]`` and its Jacobian ``[3 or 6, J]``."""
        point, rotation = self.pose(configuration)
        self._mujoco.mj_comPos(self.model, self.data)
        self._mujoco.mj_jac(
            self.model,
            self.data,
            self._jacobian_position,
            self._jacobian_rotation,
            point,
            self.body,
        )
        error = target - point
        jacobian = self._jacobian_position[:, self.dof_index]
        if orientation is None:
            return error, jacobian
        weight = self.rotation_weight
        turn = rotation_vector(orientation @ rotation.T)
        return (
            np.concatenate([error, weight * turn]),
            np.concatenate(
                [jacobian, weight * self._jacobian_rotation[:, self.dof_index]]
            ),
        )

    def _step(
        self,
        joints: NDArray[np.float64],
        error: NDArray[np.float64],
        jacobian: NDArray[np.float64],
        posture: NDArray[np.float64] | None,
    ) -> NDArray[np.float64]:
        """Returns the change of the joints ``[J]`` within the limits."""
        low, high = self.limits.T
        free = np.ones(joints.size, dtype=bool)
        step = np.zeros(joints.size)
        for _ in range(joints.size):
            reduced = jacobian * free
            square = reduced @ reduced.T
            square[np.diag_indices_from(square)] += self.damping**2
            inverse = np.linalg.solve(square, reduced).T
            step = inverse @ error
            if posture is not None:
                pull = self.posture_gain * (posture - joints) * free
                step = step + pull - inverse @ (reduced @ pull)
            largest = np.abs(step).max()
            if largest > self.max_step:
                step = step * (self.max_step / largest)
            over = free & ((joints + step > high) | (joints + step < low))
            at_limit = over & ((joints >= high - 1e-9) | (joints <= low + 1e-9))
            if not at_limit.any():
                break
            free &= ~at_limit
        return np.clip(joints + step, low, high) - joints

    def find_posture(
        self,
        qpos: ArrayLike,
        position: ArrayLike,
        rotation: ArrayLike | None = None,
        *,
        near: ArrayLike,
        rng: np.random.Generator,
        restarts: int = 64,
        iterations: int = 60,
        tolerance: float = 5e-3,
    ) -> NDArray[np.float64]:
        """Searches for a configuration that reaches a pose without touching anything.

        Solves from random joint positions. Of the solutions without contacts, the one
        whose largest change from ``near`` is smallest is returned.

        Args:
            qpos (ArrayLike): positions of the whole model, ``[nq]``.
            position (ArrayLike): target of the tool point, ``[3]``, metres.
            rotation (ArrayLike, optional): target rotation matrix ``[3, 3]``. Defaults
                to ``None``: free.

        Keyword Args:
            near (ArrayLike): joint positions ``[J]`` that the result should be close
                to.
            rng (numpy.random.Generator): generator of the random starts.
            restarts (int): number of random starts. Defaults to 64.
            iterations (int): iterations from each start. Defaults to 60.
            tolerance (float): largest position error of a solution, metres.
                Defaults to 0.005.

        Returns:
            numpy.ndarray: joint positions ``[J]``.

        Raises:
            RuntimeError: no start led to a collision-free solution.
        """
        centre = np.asarray(near, dtype=np.float64)
        configuration = np.array(qpos, dtype=np.float64)
        best: NDArray[np.float64] | None = None
        best_cost = np.inf
        for attempt in range(restarts):
            spread = 0.0 if attempt == 0 else 1.5 * attempt / restarts
            start = centre + spread * rng.standard_normal(centre.size)
            configuration[self.qpos_index] = np.clip(start, *self.limits.T)
            solution = self.solve(
                configuration, position, rotation, iterations=iterations
            )
            if (
                solution.position_error > tolerance
                or solution.rotation_error > 10 * tolerance
            ):
                continue
            cost = float(np.abs(solution.joints - centre).max())
            if cost >= best_cost:
                continue
            configuration[self.qpos_index] = solution.joints
            if self.in_collision(configuration):
                continue
            best, best_cost = solution.joints, cost
        if best is None:
            raise RuntimeError(
                f"no collision-free posture in {restarts} starts for the tool at "
                f"{np.asarray(position).round(3).tolist()}; use more restarts, or a "
                "target farther from the furniture"
            )
        return best

    def find_route(
        self,
        qpos: ArrayLike,
        target: ArrayLike,
        via: Iterable[ArrayLike],
        *,
        clearance: float = 0.02,
        spacing: float = 0.15,
    ) -> list[NDArray[np.float64]]:
        """Chooses a path in joint space: straight, or through one of several postures.

        Args:
            qpos (ArrayLike): positions of the whole model, ``[nq]``, where the path
                starts.
            target (ArrayLike): joint positions ``[J]`` where it ends.
            via (iterable of ArrayLike): joint positions ``[J]`` that it may pass
                through.

        Keyword Args:
            clearance (float): distance to keep from everything but the robot, metres.
                Defaults to 0.02.
            spacing (float): largest change of a joint between two configurations that
                are checked, radians. Defaults to 0.15.

        Returns:
            list of numpy.ndarray: the postures to go to in sequence, ``target`` last:
            the path with the fewest configurations that are too close, and of those
            the shortest.
        """
        configuration = np.array(qpos, dtype=np.float64)
        begin, end = configuration[self.qpos_index], np.asarray(target, np.float64)

        def leg(first: NDArray[np.float64], last: NDArray[np.float64]) -> int:
            count = int(np.ceil(np.abs(last - first).max() / spacing))
            close = 0
            for share in np.arange(1, count + 1) / max(count, 1):
                configuration[self.qpos_index] = first + share * (last - first)
                close += self.in_collision(configuration, clearance)
            return close

        best, best_cost = [end], (leg(begin, end), float(np.abs(end - begin).max()))
        for posture in via:
            if best_cost[0] == 0:
                break
            middle = np.asarray(posture, dtype=np.float64)
            length = np.abs(middle - begin).max() + np.abs(end - middle).max()
            cost = (leg(begin, middle) + leg(middle, end), float(length))
            if cost < best_cost:
                best, best_cost = [middle, end], cost
        return best

    def in_collision(self, qpos: ArrayLike, clearance: float = 0.0) -> bool:
        """Returns whether the solver's part of the robot touches something.

        Args:
            qpos (ArrayLike): positions of the whole model, ``[nq]``.
            clearance (float): distance to anything but the robot that counts as
                touching, metres. Defaults to 0.

        Returns:
            bool: whether a body that the solver's joints move penetrates another body,
            the robot's own included, or is nearer than ``clearance`` to something that
            is not the robot.
        """
        self.data.qpos[:] = qpos
        self._mujoco.mj_kinematics(self.model, self.data)
        self._mujoco.mj_collision(self._with_margin(clearance), self.data)
        contact = self.data.contact
        bodies = self.model.geom_bodyid[contact.geom]
        near = np.where(self._robot[bodies].all(axis=1), 0.0, clearance)
        return bool((self._moved[bodies].any(axis=1) & (contact.dist < near)).any())

    def _with_margin(self, clearance: float) -> Any:
        """Returns a model whose contacts begin at that distance."""
        if clearance == 0:
            return self.model
        if clearance not in self._margins:
            model = copy.copy(self.model)
            model.geom_margin[self._moved[model.geom_bodyid]] = clearance
            self._margins[clearance] = model
        return self._margins[clearance]
