# SPDX-License-Identifier: Apache-2.0

"""Make a package nav2_msgs with one action: python -m tests.doors.bridges.make_nav2 FOLDER.

There is no wheel of nav2_msgs. The wheels of rosidl generate the code, g++ compiles it.
"""

import os
import subprocess
import sys
import sysconfig
from inspect import signature
from pathlib import Path

import numpy

PREFIX = Path(sys.prefix)
os.environ["AMENT_PREFIX_PATH"] = str(PREFIX)

from rosidl_generator_c.cli import GenerateC  # noqa: E402
from rosidl_generator_py.cli import GeneratePython  # noqa: E402
from rosidl_generator_type_description.cli import HashTypeDescription  # noqa: E402
from rosidl_typesupport_c.cli import GenerateCTypesupport  # noqa: E402
from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport  # noqa: E402
from rosidl_typesupport_introspection_c.cli import GenerateIntrospectionCTypesupport  # noqa: E402

NAME = "NavigateToPose"
FIELDS = {
    "Goal": ("geometry_msgs::msg::PoseStamped pose", "string behavior_tree"),
    "Result": ("uint16 error_code", "string error_msg"),
    "Feedback": (
        "geometry_msgs::msg::PoseStamped current_pose",
        "builtin_interfaces::msg::Duration navigation_time",
        "builtin_interfaces::msg::Duration estimated_time_remaining",
        "int16 number_of_recoveries",
        "float distance_remaining",
    ),
}
"""Fields of goal, result and feedback. Source: nav2_msgs/action/NavigateToPose of Nav2."""
FIRST, SECOND = (
    f"libnav2_msgs__rosidl_typesupport_{kind}_c.so" for kind in ("fastrtps", "introspection")
)
"""Names under which the type supports look for each other."""


PACKAGES = (
    *("builtin_interfaces", "geometry_msgs", "std_msgs"),
    *("action_msgs", "service_msgs", "unique_identifier_msgs"),
)
MORE = (
    *("fastcdr", "rcutils", "rosidl_runtime_c"),
    *(f"rosidl_typesupport_{kind}" for kind in ("c", "fastrtps_c", "fastrtps_cpp")),
)


def generate(folder):
    """Write the code into nav2_msgs and introspection in `folder`."""
    lines = [
        '#include "builtin_interfaces/msg/Duration.idl"',
        '#include "geometry_msgs/msg/PoseStamped.idl"',
    ]
    lines += ["module nav2_msgs { module action {"]
    for part, fields in FIELDS.items():
        lines.append(f"struct {NAME}_{part} {{ {' '.join(f'{field};' for field in fields)} }};")
    (folder / "action").mkdir(parents=True)
    (folder / "action" / f"{NAME}.idl").write_text("\n".join([*lines, "}; };\n"]))
    about = "nav2_msgs", [f"{folder}:action/{NAME}.idl"], [str(PREFIX / "share")]
    made = folder / "nav2_msgs"
    HashTypeDescription("hash").generate_type_hashes(*about, made)
    hashes = {"type_description_files": [str(made / "action" / f"{NAME}.json")]}
    kinds = [GenerateC, GeneratePython, GenerateCTypesupport, GenerateFastRTPSCTypesupport]
    for kind in [*kinds, GenerateIntrospectionCTypesupport]:
        run = kind("any").generate
        is_second = kind is GenerateIntrospectionCTypesupport
        out = folder / "second" / "nav2_msgs" if is_second else made
        more = hashes if "type_description_files" in signature(run).parameters else {}
        run(*about, output_path=out, **more)


def build(folder):
    """Compile the code."""
    made = folder / "nav2_msgs"
    include = PREFIX / "include"
    roots = [include, *include.iterdir(), folder, folder / "second", numpy.get_include()]
    flags = [f"-I{root}" for root in [*roots, sysconfig.get_path("include")]]
    kinds = "generator_c", "generator_py", "typesupport_c", "typesupport_fastrtps_c"
    names = [f"{package}__rosidl_{kind}" for package in PACKAGES for kind in kinds]
    libraries = [f"-l:lib{name}.so" for name in [*names, *MORE]]

    def link(sources, name, target, *more):
        objects = []
        for source in sources:
            objects.append(f"{source}.o")
            compiler = "g++" if source.suffix == ".cpp" else "gcc"
            subprocess.run([compiler, "-fPIC", "-c", source, "-o", objects[-1], *flags], check=True)
        where = f"-L{PREFIX}/lib", f"-L{made}", f"-Wl,-soname,{name}", "-Wl,-rpath,$ORIGIN"
        subprocess.run(["g++", "-shared", "-o", target, *objects, *where, *more], check=True)

    second = [f"-l:lib{package}__rosidl_typesupport_introspection_c.so" for package in PACKAGES]
    link([*(folder / "second").rglob("*.c")], SECOND, made / SECOND, *second)
    sources = [*(made / "action").rglob("*.c"), *(made / "action").rglob("*.cpp")]
    sources.append(made / "_nav2_msgs_s.ep.rosidl_typesupport_c.c")
    module = made / "nav2_msgs_s__rosidl_typesupport_c.so"
    link(sources, FIRST, module, *libraries, "-Wl,--no-as-needed", f"-l:{SECOND}")
    (made / "__init__.py").touch()


if __name__ == "__main__":
    generate(Path(sys.argv[1]).resolve())
    build(Path(sys.argv[1]).resolve())
