"""The simulated arm and what it does to a person: MuJoCo, built from the arm's own data files.

An oracle that shares no code with the controller: MuJoCo reads the URDF itself; dynamics, distances and contacts are
MuJoCo's. The joints are torque motors at 1 kHz under a stiff servo, as on the real arm: inverse dynamics, a velocity
loop, and a position loop that asks for no more than the data sheet's speed; torque is cut at the URDF's efforts.
A torque-controlled arm has no servo: the torque that is set acts for one period.
The arm meets the person only: not itself and not the floor. Contacts are found and told but push nobody: the person is
a script that gives way to nothing, and no arm's servo answers a person of infinite force as a real contact would.
Units: SI, radians; robot base frame.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from asc_rt.core.params import CapsuleSpec, Params, ToolParams
from asc_rt.core.types import MAX_CAPSULES
from sim_hil.person import FLOOR_Z, Capsules

Array = npt.NDArray[np.float64]
Three = tuple[float, float, float]
Wall = tuple[Three, Three]  # centre and half sizes of a box, m

SUBSTEP = 0.001  # s
SERVO_BANDWIDTH = 120.0  # rad/s, ASSUMED: far above what a robot controller's set-points contain
ROTOR_INERTIA = 1e-3  # kg m2 at the joint per Nm of effort, ASSUMED: not published, the size of a geared servo motor's.
# Position-controlled arms only: the identified inertias of a torque-controlled one include what its motors add.
BRAKE_SHARE = 2.0  # holding torque of a joint's brake, share of the effort, ASSUMED
BRAKE_STIFF = (0.002, 1.0, 0.99999)  # time constant s, damping, impedance: a closed brake must not creep
PARKED = np.array([0.0, 0.0, -1000.0])  # m, where unused capsules of the person wait
NO_FORCE = 1e3  # m: contacts are found at 0 (margin + gap) and push only when this deep (margin)
FAR = 1e3  # m, beyond this MuJoCo need not look
SHORTEST = 1e-4  # m, half length of a person's capsule that is a sphere


@dataclass(frozen=True, slots=True)
class Nearest:
    """The nearest robot-person pair of capsules."""

    distance: float  # m between the surfaces, below zero inside; inf: nobody is there
    robot_part: str  # URDF link, or tool0, tool1...
    person_part: str
    approach: float  # m/s, of the robot's nearest point towards the person, by the robot's own motion


NOBODY = Nearest(float("inf"), "", "", 0.0)


@dataclass(frozen=True, slots=True)
class Contact:
    robot_part: str
    person_part: str
    depth: float  # m, deepest within the last period


class MujocoPlant:
    """`set_target`, then `step` one control period. Starts at rest at `q0` (rad; default all zero).

    ValueError: URDF and joint list disagree. FloatingPointError from `step`: the simulation has diverged.
    """

    def __init__(self, params: Params, q0: npt.ArrayLike | None = None) -> None:
        self._params = params
        self._take(self._built(params))
        names = [self._model.joint(i).name for i in range(self._model.njnt)]
        if names != list(params.robot.joints) or self._model.nv != params.n:
            raise ValueError(f"joints of the URDF are {names}, of the profile {list(params.robot.joints)}")
        self._period = params.period
        self._model.dof_solref[:] = BRAKE_STIFF[:2]
        self._model.dof_solimp[:, :2] = BRAKE_STIFF[2]
        self._brake = BRAKE_SHARE * self._model.jnt_actfrcrange[:, 1]
        self._fastest = np.array(params.robot.dq_max)
        self.reset(np.zeros(params.n) if q0 is None else q0)

    def _built(self, params: Params) -> Any:
        return build(params)

    def _take(self, model: Any) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        self._substeps = max(1, round(self._params.period / SUBSTEP))
        model.opt.timestep = self._params.period / self._substeps
        self._robot_geoms = [g for g in range(self._model.ngeom) if self._model.geom(g).name.startswith("robot/")]
        self._person_geoms = [self._model.geom(f"person/{i}").id for i in range(MAX_CAPSULES)]
        self._robot, self._persons = np.array(self._robot_geoms), np.array(self._person_geoms)
        self._carried = self._robot[-max(1, len(self._params.tool.capsules)) :]

    def carry(self, tool: ToolParams) -> None:
        """Another tool from now on, shape and mass; the arm goes on as it moves, people stay where they are."""
        before, size, bound = self._data, self._model.geom_size, self._model.geom_rbound
        people = size[self._person_geoms], bound[self._person_geoms]
        self._params = dataclasses.replace(self._params, tool=tool)
        self._take(self._built(self._params))
        self._model.geom_size[self._person_geoms], self._model.geom_rbound[self._person_geoms] = people
        for name in ("time", "qpos", "qvel", "ctrl", "mocap_pos", "mocap_quat"):
            setattr(self._data, name, getattr(before, name))
        mujoco.mj_step1(self._model, self._data)

    @property
    def tool(self) -> str:
        """Name of what it carries."""
        return self._params.tool.name

    @property
    def q(self) -> Array:
        return self._data.qpos.copy()

    @property
    def dq(self) -> Array:
        return self._data.qvel.copy()

    @property
    def torque(self) -> Array:
        """Nm, of the last substep, after the limit."""
        return self._data.qfrc_actuator.copy()

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """All contacts of robot and person within the last period."""
        return tuple(Contact(*parts, depth) for parts, depth in self._contacts.items())

    def reset(self, q: npt.ArrayLike) -> None:
        """At rest at q, nobody there."""
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:] = q
        self._torque: Array | None = None
        self._reached = self._target = self.q  # where the servo was and will be, at the end of a period
        self._data.mocap_pos[:] = PARKED
        self._labels: tuple[str, ...] = ()
        self._contacts: dict[tuple[str, str], float] = {}
        mujoco.mj_step1(self._model, self._data)

    def set_target(self, q: npt.ArrayLike) -> None:
        """Where the servo shall be at the end of the next period. ValueError: not finite numbers, one per joint."""
        target = np.array(q, dtype=np.float64)
        if target.shape != self._target.shape or not np.isfinite(target).all():
            raise ValueError(f"target {target.tolist()}: {len(self._target)} finite angles are needed")
        self._target = target

    def set_torque(self, tau: npt.ArrayLike) -> None:
        """Torque of the coming periods, instead of the servo. ValueError: not finite numbers, one per joint."""
        torque = np.array(tau, dtype=np.float64)
        if torque.shape != self._target.shape or not np.isfinite(torque).all():
            raise ValueError(f"torque {torque.tolist()}: {len(self._target)} finite torques are needed")
        self._torque = torque

    def set_brakes(self, closed: npt.ArrayLike) -> None:
        """Joints whose brake is closed, (n,) bool: dry friction that no motor of the arm overcomes."""
        self._model.dof_frictionloss[:] = np.where(closed, self._brake, 0.0)

    def step(self) -> None:
        """One control period: the servo follows a straight line from the last target to the new one."""
        model, data = self._model, self._data
        self._contacts = {}
        for i in range(self._substeps):
            data.ctrl[:] = self._servo((i + 1) / self._substeps) if self._torque is None else self._torque
            mujoco.mj_step2(model, data)
            mujoco.mj_step1(model, data)  # positions, velocities and contacts of the new state
            if data.ncon:
                self._note_contacts()
        if not np.isfinite(data.qpos).all():
            raise FloatingPointError("the simulated arm has diverged")
        self._reached = self._target

    def _servo(self, share: float) -> Array:
        """Torque of the servo, `share` of the period on: inverse dynamics plus the two loops."""
        way, data = self._target - self._reached, self._data
        catch_up = np.clip(
            SERVO_BANDWIDTH / 2 * (self._reached + way * share - data.qpos), -self._fastest, self._fastest
        )
        torque: Array = np.empty(self._model.nv)
        mujoco.mj_mulM(self._model, data, torque, 2 * SERVO_BANDWIDTH * (way / self._period + catch_up - data.qvel))
        return torque + data.qfrc_bias

    def set_person(self, person: Capsules) -> None:
        """Put the person there. ValueError: more capsules than the plant has."""
        m = len(person.radius)
        if m > MAX_CAPSULES:
            raise ValueError(f"{m} capsules of people, at most {MAX_CAPSULES}")
        axis = person.p1 - person.p0
        half = np.maximum(np.linalg.norm(axis, axis=1) / 2, SHORTEST)
        geoms = self._person_geoms[:m]
        self._model.geom_size[geoms, 0] = person.radius
        self._model.geom_size[geoms, 1] = half
        self._model.geom_rbound[geoms] = person.radius + half
        self._data.mocap_pos[:m] = (person.p0 + person.p1) / 2
        self._data.mocap_quat[:m] = _turn_z_to(axis)
        self._data.mocap_pos[m:] = PARKED
        self._labels = tuple(person.labels)
        mujoco.mj_step1(self._model, self._data)

    def distance(self, approach_within: float = np.inf) -> Nearest:
        """Smallest distance of all robot-person pairs, now. Its `approach` is worked out nearer than `approach_within`
        only, else zero."""
        return self._nearest(self._robot, approach_within)

    def tool_distance(self, nearest: Nearest | None = None) -> float:
        """From what it carries, or from the arm's last capsule where that is nothing, to the nearest person, m;
        `nearest`: of the whole arm, now, if it is known."""
        if nearest is not None and nearest.robot_part in [self._part(int(geom)) for geom in self._carried]:
            return nearest.distance
        return self._nearest(self._carried).distance

    def _nearest(self, robot: npt.NDArray[np.int64], approach_within: float = 0.0) -> Nearest:
        if not self._labels:
            return NOBODY
        model, data = self._model, self._data
        person = self._persons[: len(self._labels)]
        apart = data.geom_xpos[robot][:, None] - data.geom_xpos[person][None]
        bound = model.geom_rbound
        centres = np.sqrt(np.einsum("rpx,rpx->rp", apart, apart))
        at_least = (centres - bound[robot][:, None] - bound[person][None]).ravel()
        best, pair, points = FAR, (0, 0), np.zeros((6, 1))
        ends = np.zeros((6, 1))
        for index in np.argsort(at_least):  # spheres around the capsules: most pairs need no closer look
            if at_least[index] >= best:
                break
            candidate = divmod(int(index), len(person))
            d = mujoco.mj_geomDistance(model, data, robot[candidate[0]], person[candidate[1]], FAR, ends)
            if d < best:
                best, pair, points = d, candidate, ends.copy()
        approach = 0.0
        if best < approach_within:
            approach = self._approach(int(robot[pair[0]]), points[:3, 0], points[3:, 0], best)
        return Nearest(best, self._part(int(robot[pair[0]])), self._labels[pair[1]], approach)

    def truth(self, t_ns: int) -> dict[str, Any]:
        """What the arm did and how near somebody is, as told to the record; `t_ns`: monotonic time of this period."""
        nearest = self.distance()
        return {
            "t_ns": t_ns,
            "q": self.q.tolist(),
            "dq": self.dq.tolist(),
            "distance_m": nearest.distance if np.isfinite(nearest.distance) else None,
            "robot_part": nearest.robot_part,
            "person_part": nearest.person_part,
            "approach_m_s": nearest.approach,
            "contact": bool(self.contacts),
        }

    def _approach(self, geom: int, at: Array, towards: Array, distance: float) -> float:
        line = (towards - at) * np.sign(distance)  # inside each other, the points change sides
        length = float(np.linalg.norm(line))
        if length == 0.0:
            return 0.0
        jacobian = np.zeros((3, self._model.nv))
        mujoco.mj_jac(self._model, self._data, jacobian, None, at[:, None], self._model.geom_bodyid[geom])
        return float(line @ jacobian @ self._data.qvel) / length

    def _note_contacts(self) -> None:
        contact = self._data.contact
        for (robot, person), depth in zip(contact.geom, -contact.dist, strict=True):
            parts = (self._part(int(robot)), self._labels[self._person_geoms.index(int(person))])
            self._contacts[parts] = max(float(depth), self._contacts.get(parts, 0.0))

    def _part(self, geom: int) -> str:
        return str(self._model.geom(geom).name).split("/")[1]


@functools.lru_cache(maxsize=16)  # a swap takes no longer than a step
def _spec(params: Params, walls: tuple[Wall, ...] = ()) -> Any:
    spec = mujoco.MjSpec.from_string(params.robot.urdf)
    spec.compiler.fusestatic = False  # keeps base and flange as bodies
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_AUTORESET  # a diverged run must not look like a fresh one
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    floor = spec.worldbody.add_geom(name="floor", pos=[0, 0, FLOOR_Z], size=[5, 5, 0.1], contype=0, conaffinity=0)
    floor.type = mujoco.mjtGeom.mjGEOM_PLANE
    spec.compiler.discardvisual = not walls  # what collides with nothing is left out, unless it is to be seen
    for i, (pos, size) in enumerate(walls):
        wall = spec.worldbody.add_geom(name=f"wall{i}", pos=pos, size=size, contype=0, conaffinity=0)
        wall.type = mujoco.mjtGeom.mjGEOM_BOX
    counts: dict[str, int] = {}
    for capsule in params.robot.capsules:
        i = counts[capsule.link] = counts.get(capsule.link, -1) + 1
        _add_capsule(spec.body(capsule.link), f"robot/{capsule.link}/{i}", capsule)
    flange = spec.body(params.robot.flange)
    _add_mass(flange, params.tool)
    for i, capsule in enumerate(params.tool.capsules):
        _add_capsule(flange, f"robot/tool{i}", capsule)
    robot = [geom.name for geom in spec.geoms if geom.name.startswith("robot/")]
    for i in range(MAX_CAPSULES):
        body = spec.worldbody.add_body(name=f"person/{i}", mocap=True)
        geom = body.add_geom(name=f"person/{i}", type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[0.05, SHORTEST, 0])
        geom.contype = geom.conaffinity = 0
        for name in robot:  # explicit pairs pass by the bounding tree, which would not know of changed capsule sizes
            spec.add_pair(geomname1=name, geomname2=geom.name, condim=1, margin=-NO_FORCE, gap=NO_FORCE)
    for joint in spec.joints:
        motor = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_motor()
        if params.control != "torque":
            joint.armature = ROTOR_INERTIA * joint.actfrcrange[1]  # the URDF's effort
    return spec.compile()


def build(params: Params, walls: tuple[Wall, ...] = ()) -> Any:
    return copy.copy(_spec(params, walls))  # sizes of people are written into it


def _add_capsule(body: Any, name: str, capsule: CapsuleSpec) -> None:
    is_sphere = capsule.p0 == capsule.p1
    geom = body.add_geom(name=name, contype=0, conaffinity=0, mass=0)
    if is_sphere:
        geom.type, geom.pos, geom.size = mujoco.mjtGeom.mjGEOM_SPHERE, capsule.p0, [capsule.radius, 0, 0]
    else:
        geom.type, geom.fromto = mujoco.mjtGeom.mjGEOM_CAPSULE, [*capsule.p0, *capsule.p1]
        geom.size = [capsule.radius, 0, 0]


def _add_mass(flange: Any, tool: ToolParams) -> None:
    if tool.mass > 0:
        xx, xy, xz, yy, yz, zz = tool.inertia
        flange.mass, flange.ipos, flange.fullinertia = tool.mass, tool.com, [xx, yy, zz, xy, xz, yz]


def _turn_z_to(axis: Array) -> Array:
    """Quaternions (w, x, y, z) that turn the z axis to these directions; any for a zero axis."""
    u = axis / np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-12)
    quaternion = np.stack([1 + u[:, 2], -u[:, 1], u[:, 0], np.zeros(len(u))], axis=1)
    quaternion[u[:, 2] < -1 + 1e-9] = [0.0, 1.0, 0.0, 0.0]
    return quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
