# SPDX-License-Identifier: Apache-2.0

"""A node of ROS 2 that is right, or wrong in one way: python -m tests.doors.bridges.node KIND."""

import os
import signal
import sys
import time

import rclpy
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.utilities import remove_ros_args

KIND, *MORE = remove_ros_args(sys.argv)[1:]
AFTER = 30
"""Number of answers before a node becomes wrong."""
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

rclpy.init()
node = rclpy.create_node(KIND, namespace=MORE[0] if MORE else None)
kind = Twist if KIND == "unstamped" else PoseStamped if KIND == "type" else TwistStamped
commands = node.create_publisher(kind, "cloudrc/cmd_vel", 1)
count = 0
setpoint = None


def hear(message):
    global setpoint
    setpoint = message


def answer(estimate):
    global count
    count += 1
    if setpoint is None or (KIND == "silent" and count > AFTER):
        return
    if KIND == "slow" and count > AFTER:
        time.sleep(10)
    if KIND == "tardy":
        time.sleep(0.6)
    command = kind()
    if KIND in ("unstamped", "type"):
        twist = command if KIND == "unstamped" else None
    else:
        command.header.stamp = estimate.header.stamp
        twist = command.twist
    if twist is not None:
        wanted, now = setpoint.pose.position, estimate.pose.pose.position
        twist.linear.x = 0.8 * (wanted.x - now.x)
        twist.linear.y = 0.8 * (wanted.y - now.y)
        twist.linear.z = 1.5 * (wanted.z - now.z)
    if count > AFTER:
        if KIND == "nan":
            twist.linear.y = float("nan")
        elif KIND == "stamp":
            command.header.stamp.nanosec += 5
        elif KIND == "twice":
            commands.publish(command)
            time.sleep(0.05)
        elif KIND == "killed":
            os.kill(os.getpid(), signal.SIGKILL)
    commands.publish(command)


node.create_subscription(PoseStamped, "cloudrc/setpoint", hear, LATCHED if KIND == "latched" else 1)
node.create_subscription(Odometry, "cloudrc/estimate", answer, 1)
rclpy.spin(node)
