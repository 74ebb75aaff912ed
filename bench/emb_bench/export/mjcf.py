"""A brake as a model of MuJoCo (MJCF): one hinge joint, driven by a current [A].

J is the joint's armature, f_v its damping, T_c its friction loss, k_m the gear of the motor. A tendon exerts the
clamping force [N]: its length is the travel of the clamp, γ times the angle, and it is slack below contact. MuJoCo's
friction loss is a soft constraint for each step: the time of a reversal is as precise as the step.
"""

from __future__ import annotations

from emb_runtime.config.bench import Bench, BrakeParameters

STEPS = 10  # Of the simulation, per sample time

_TEXT = """\
<!-- Made by emb-excite. Units: rad, s, A, N, N·m, kg·m². Read with mujoco.MjModel.from_xml_path. -->
<mujoco model="brake">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="{step:.12g}" integrator="RK4" gravity="0 0 0">
    <flag contact="disable"/>
  </option>
  <worldbody>
    <body name="motor">
      <inertial pos="0 0 0" mass="1e-3" diaginertia="1e-12 1e-12 1e-12"/>
      <joint name="motor" type="hinge" axis="0 0 1" armature="{p.J!r}" damping="{p.f_v!r}" frictionloss="{p.T_c!r}"
             solreffriction="{time_constant:.12g} 1" solimpfriction="0.9999 0.9999 0.001"/>
    </body>
  </worldbody>
  <tendon>
    <fixed name="clamp" stiffness="{stiffness!r}" springlength="-1 0">
      <joint joint="motor" coef="{p.gamma!r}"/>
    </fixed>
  </tendon>
  <actuator>
    <motor name="current" joint="motor" gear="{p.k_m!r}" ctrlrange="-{current!r} {current!r}"/>
  </actuator>
  <sensor>
    <jointpos name="angle" joint="motor"/>
    <jointvel name="velocity" joint="motor"/>
  </sensor>
</mujoco>
"""


def mjcf(bench: Bench, brake: BrakeParameters) -> str:
    """The text of the model, with the sample time and the largest current of the bench."""
    step = bench.timing.sample_time / STEPS
    return _TEXT.format(
        p=brake, step=step, time_constant=2.0 * step, stiffness=brake.k_1 / brake.gamma, current=bench.limits.current
    )
