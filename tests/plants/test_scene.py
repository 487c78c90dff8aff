"""Contacts of obstacles in MuJoCo: the contact pairs of the model, and the depth of a sliding finger."""

from __future__ import annotations

import mujoco
import numpy as np

from q2r2_control.config.cell import Config
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.plants.scene import let_fingers_slide, set_obstacles
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

LOAD = 20.0  # Force that presses the pad on the table [N].
# Mass of the pad [kg]. MuJoCo scales stiffness with the lightest moving part, such as a finger in its gripper.
MASS = 0.1


def test_every_finger_pad_has_a_contact_pair_with_the_table_and_the_friction_of_the_cell(
    robot: Robot, config: Config
) -> None:
    slippery = config.mujoco.model_copy(update={"obstacle_friction": 0.3})
    model = MujocoPlant(robot, config.model_copy(update={"mujoco": slippery})).model
    table = model.geom("table_collision").id
    pads = {
        index
        for index in range(model.ngeom)
        if model.geom_contype[index] and "_finger_" in model.body(model.geom_bodyid[index]).name
    }
    sponge = model.geom("sponge").id
    named = {frozenset(pair) for pair in zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)}
    assert len(pads) >= 4
    assert named == {frozenset((shape, table)) for shape in (*pads, sponge)}
    np.testing.assert_array_equal(model.pair_friction[:, :2], 0.3)
    assert model.geom_friction[table, 0] == 0.3
    # The table is as stiff for a finger as for any other body.
    of_pads = model.pair_solref[(model.pair_geom1 != sponge) & (model.pair_geom2 != sponge)]
    np.testing.assert_array_equal(of_pads, np.tile(model.geom_solref[table], (len(pads), 1)))


def test_a_force_compresses_a_soft_object_by_the_force_divided_by_its_stiffness(robot: Robot, config: Config) -> None:
    plant = MujocoPlant(robot, config)
    sponge, heights = plant.model.body("sponge").id, []
    for force in (0.0, 5.0, 10.0):
        plant.data.xfrc_applied[sponge, 2] = -force
        mujoco.mj_step(plant.model, plant.data, 1000)
        heights.append(plant.data.xpos[sponge, 2])
    stiffness = config.mujoco.objects["sponge"].stiffness
    assert stiffness is not None
    np.testing.assert_allclose(-np.diff(heights), 5.0 / stiffness, rtol=0.05)


def depths(config: Config, speed: float, named: bool) -> Array:
    """Return how deep a pad is in the table at each millisecond [m]. It slides at ``speed`` [m/s] under :data:`LOAD`.

    If ``named`` is True, the model has contact pairs of pads and obstacles.
    """
    spec = mujoco.MjSpec()
    spec.option.cone, spec.option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 100.0
    spec.option.gravity = (0.0, 0.0, -LOAD / MASS)
    table = spec.worldbody.add_body(name="table")
    table.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=(5.0, 1.0, 0.1), pos=(0.0, 0.0, -0.1))
    finger = spec.worldbody.add_body(name="finger", pos=(0.0, 0.0, 0.01))
    for name, axis, rotors in (("x", (1, 0, 0), 100.0), ("z", (0, 0, 1), 0.0)):
        finger.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis, armature=rotors)
    finger.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=(0.01, 0.01, 0.01), mass=MASS, priority=1)
    set_obstacles(spec, config)
    if named:
        let_fingers_slide(spec, config)
    model = spec.compile()
    data = mujoco.MjData(model)
    seen = []
    for step in range(2000):
        data.joint("x").qvel = speed
        mujoco.mj_step(model, data)
        if step > 1500:
            seen.append(-data.joint("z").qpos[0])
    return np.array(seen)


def test_a_finger_that_slides_stays_in_contact_at_about_the_depth_of_a_resting_finger(config: Config) -> None:
    """If friction acted as fast as the contact force, the finger would rise by its whole depth, and hop."""
    still = depths(config, 0.0, named=True)
    np.testing.assert_allclose(still, depths(config, 0.0, named=False), rtol=0.01)
    sliding = depths(config, 0.1, named=True)
    assert sliding.min() > 0.6 * still.mean()
    assert sliding.max() <= still.max()
    assert depths(config, 0.1, named=False).min() < 0.0
