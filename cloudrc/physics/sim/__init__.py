# SPDX-License-Identifier: Apache-2.0

"""The simulator: MuJoCo, and all that knows it.

`engine` imports MuJoCo. `scene` compiles a robot in a scene, `simulator` moves it. `bodies`,
`airframe`, `wheels` and `shapes` read facts of scenes and robots as plain data for all others.
`onboard` and `readings` are the interface of the robot's controller.
"""
