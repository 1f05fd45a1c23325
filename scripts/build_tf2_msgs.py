"""Compile tf2_msgs/msg/TFMessage into the virtual environment that runs this script.

The ROS 2 wheels on PyPI hold no tf2_msgs, and without it nobody can publish /tf. TFMessage needs
nothing but geometry_msgs, so the wheels' own rosidl generators and a C++ compiler build it here
in seconds, with the same type hash as a ROS installation's.

Only the message is built: this package uses none of tf2_msgs' actions and services.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import io
import os
from pathlib import Path
import shutil
import subprocess
import sys
import sysconfig
import tempfile

import numpy as np
from rosidl_cli.command.generate.api import generate

PACKAGE = 'tf2_msgs'
MESSAGE = 'geometry_msgs/TransformStamped[] transforms\n'
MANIFEST = """<?xml version="1.0"?>
<package format="3">
  <name>tf2_msgs</name>
  <version>0.36.0</version>
  <description>TFMessage alone, built from its definition by slam_observer_ros.</description>
  <maintainer email="founders@slam-observer-ros.invalid">slam_observer_ros founders</maintainer>
  <license>BSD-3-Clause</license>
  <depend>geometry_msgs</depend>
</package>
"""
DISPATCHED_TYPESUPPORTS = ('fastrtps_c', 'introspection_c')
TYPESUPPORTS = ('c', *DISPATCHED_TYPESUPPORTS)
MESSAGE_DEPENDENCIES = ('geometry_msgs', 'std_msgs', 'builtin_interfaces')
RUNTIME_LIBRARIES = (
    'rosidl_runtime_c', 'rosidl_typesupport_c', 'rosidl_typesupport_fastrtps_c',
    'rosidl_typesupport_fastrtps_cpp', 'rosidl_typesupport_introspection_c',
    'rosidl_dynamic_typesupport', 'fastcdr', 'rmw', 'rcutils',
)  # fmt: skip

PREFIX = Path(sys.prefix)
PYTHON_PACKAGE = Path(sysconfig.get_path('purelib')) / PACKAGE
PYTHON_HEADERS = Path(sysconfig.get_path('include'))


def main() -> None:
    """Build, install and load tf2_msgs, or say why it can't be built."""
    if not (shutil.which('cc') and shutil.which('c++') and (PYTHON_HEADERS / 'Python.h').exists()):
        print('tf2_msgs needs a C and a C++ compiler and the Python headers: built without it.')
        print('Everything works but /tf, which is not published.')
        return
    with tempfile.TemporaryDirectory(prefix=f'{PACKAGE}_') as folder:
        build = Path(folder)
        generate_sources(build)
        install_python_package(build)
        install_share(build)
        compile_libraries(build)
    load = f'from {PACKAGE}.msg import TFMessage; TFMessage.__import_type_support__()'
    subprocess.run([sys.executable, '-c', load], check=True)
    print(f'tf2_msgs is built into {PREFIX}')


def generate_sources(build: Path) -> None:
    """Run the rosidl generators, each into a folder of its own: ``build/<kind>_<name>``."""
    os.environ['AMENT_PREFIX_PATH'] = str(PREFIX)
    use_each_entry_point_once()
    source = build / 'source'
    (source / 'msg').mkdir(parents=True)
    (source / 'msg' / 'TFMessage.msg').write_text(MESSAGE)
    kinds = [('types', 'c'), ('types', 'py'), *(('typesupports', name) for name in TYPESUPPORTS)]
    for kind, name in kinds:
        with contextlib.redirect_stdout(io.StringIO()):  # it prints every file it touches
            generate(
                package_name=PACKAGE,
                interface_files=[f'{source}:msg/TFMessage.msg'],
                include_paths=[str(PREFIX / 'share')],
                output_path=build / f'{kind}_{name}' / PACKAGE,
                **{kind: [name]},
            )


def use_each_entry_point_once() -> None:
    """Hide the second copy of the generators, which the wheels register twice.

    Each rosidl package lies in site-packages as a wheel and as an egg-info, and rosidl_cli
    refuses a name that it finds twice.
    """
    distributions = importlib.metadata.distributions()
    entries = {(e.group, e.name): e for found in distributions for e in found.entry_points}
    unique = importlib.metadata.EntryPoints(entries.values())
    importlib.metadata.entry_points = unique.select  # type: ignore[assignment]


def install_python_package(build: Path) -> None:
    """Copy the generated Python classes to site-packages."""
    shutil.rmtree(PYTHON_PACKAGE, ignore_errors=True)
    shutil.copytree(build / 'types_py' / PACKAGE / 'msg', PYTHON_PACKAGE / 'msg')
    (PYTHON_PACKAGE / '__init__.py').touch()


def install_share(build: Path) -> None:
    """Copy the definitions to share/, and list the package in the ament index."""
    share = PREFIX / 'share' / PACKAGE
    generated = build / 'types_c' / PACKAGE
    (share / 'msg').mkdir(parents=True, exist_ok=True)
    (share / 'package.xml').write_text(MANIFEST)
    shutil.copy(build / 'source' / 'msg' / 'TFMessage.msg', share / 'msg')
    shutil.copy(generated / 'tmp' / 'msg' / 'TFMessage.idl', share / 'msg')
    shutil.copy(generated / 'msg' / 'TFMessage.json', share / 'msg')
    (PREFIX / 'share' / 'ament_index' / 'resource_index' / 'packages' / PACKAGE).touch()


def compile_libraries(build: Path) -> None:
    """Compile the shared libraries and the Python extensions, dependencies first."""
    generated = {
        'generator_c': build / 'types_c',
        **{f'typesupport_{name}': build / f'typesupports_{name}' for name in TYPESUPPORTS},
        'generator_py': build / 'types_py',
    }
    headers = PREFIX / 'include'
    includes = [*generated.values(), headers, *headers.iterdir()]
    includes += [PYTHON_HEADERS, Path(np.get_include())]
    links = list(RUNTIME_LIBRARIES)
    links += [f'{name}__rosidl_{part}' for name in MESSAGE_DEPENDENCIES for part in generated]
    for part, folder in generated.items():
        library = f'{PACKAGE}__rosidl_{part}'
        sources = sorted((folder / PACKAGE / 'msg').rglob('*.c*'))
        compile_library(PREFIX / 'lib' / f'lib{library}.so', sources, includes, links)
        links.insert(0, library)
    for name in TYPESUPPORTS:
        source = build / 'types_py' / PACKAGE / f'_{PACKAGE}_s.ep.rosidl_typesupport_{name}.c'
        extension = PYTHON_PACKAGE / f'{PACKAGE}_s__rosidl_typesupport_{name}.so'
        compile_library(extension, [source], includes, links)


def compile_library(
    library: Path, sources: list[Path], includes: list[Path], links: list[str]
) -> None:
    """Compile ``sources`` to the shared ``library``, recording only the ``links`` it needs."""
    compiler = 'c++' if any(source.suffix == '.cpp' for source in sources) else 'cc'
    command = [compiler, '-shared', '-fPIC', '-O1', '-o', str(library), *map(str, sources)]
    command += [f'-I{folder}' for folder in includes]
    command += [f'-L{PREFIX / "lib"}', '-Wl,--as-needed', *(f'-l{name}' for name in links)]
    subprocess.run(command, check=True)


if __name__ == '__main__':
    main()
