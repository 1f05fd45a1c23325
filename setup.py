"""Installation for pip and for colcon (ament_python)."""

from glob import glob
import runpy

from setuptools import Extension, find_packages, setup

PACKAGE = 'slam_observer_ros'

COMPILED = runpy.run_path(f'{PACKAGE}/common/process.py')

ROS_RELEASES = ('jazzy', 'kilted')  # those whose wheels are on PyPI
ROS_WHEELS = (
    'rclpy',
    'common-interfaces',
    'rmw-fastrtps-cpp',
    'ament-flake8',
    'ament-pep257',
)

setup(
    name=PACKAGE,
    version='0.1.0',
    description='The SLAM_n(3) observer of Mahony and Hamel as a numpy library and ROS 2 nodes',
    author='slam_observer_ros founders',
    author_email='founders@slam-observer-ros.invalid',
    maintainer='slam_observer_ros founders',
    maintainer_email='founders@slam-observer-ros.invalid',
    license='Apache-2.0',
    keywords=['ROS', 'SLAM', 'nonlinear observer', 'Lie group', 'localisation', 'mapping'],
    packages=find_packages(include=[PACKAGE, f'{PACKAGE}.*']),
    package_data={PACKAGE: ['py.typed', 'report/assets/*']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
        (f'share/{PACKAGE}', ['package.xml']),
        (f'share/{PACKAGE}/launch', glob('launch/*.launch.py')),
        (f'share/{PACKAGE}/config', glob('config/*.yaml') + glob('config/*.xml')),
        (f'share/{PACKAGE}/rviz', glob('rviz/*.rviz')),
        (f'share/{PACKAGE}/samples', glob('samples/*.mcap')),
        (f'share/{PACKAGE}/foxglove', glob('foxglove/*.json')),
    ],
    ext_modules=[
        Extension(
            f'{PACKAGE}.{folder}.{name}',
            [f'{PACKAGE}/{folder}/{name}.c'],
            depends=glob(f'{PACKAGE}/filter/_*.h'),
            define_macros=[('SOURCES', COMPILED['digest_of_sources'](f'{folder}.{name}'))],
            extra_compile_args=['-O3', '-fno-math-errno'],
            optional=True,  # without a compiler numpy does the same
        )
        for folder, name in (('filter', '_core'), ('smoothing', '_gauss_newton'))
    ],
    zip_safe=False,
    python_requires='>=3.10',
    install_requires=[
        'setuptools',  # what colcon builds ament_python packages with
        'numpy',  # all the mathematics
        'scipy',  # rotation conversions, chi-square quantiles
        'PyYAML',  # the node's parameter files
    ],
    extras_require={
        # What the command line needs, and a robot does not; rosbags changes its names in any 0.x.
        'cli': [
            'rosbags>=0.11,<0.12',  # reads and writes ROS 1 bags, rosbag2 sqlite3 and MCAP
            'mcap>=1.2,<2',  # salvages recordings that were cut off, which rosbags refuses
            'matplotlib',  # figures
            'rich',  # live progress and tables in the terminal
            'argcomplete',  # completion in the shell
        ],
        'cluster': ['distributed'],  # runs a batch on the machines of a Dask cluster
        # A ROS installation brings these itself, so nothing here may come with the package.
        **{
            f'ros-{ros}': [
                *(f'ros-{ros}-{wheel}' for wheel in ROS_WHEELS),
                'catkin_pkg',  # with which rosidl_adapter reads package.xml, to build tf2_msgs
            ]
            for ros in ROS_RELEASES
        },
        'test': [
            'pytest',  # named in this extra, it is what `colcon test` runs
            'pytest-timeout',  # a ROS test that hangs must fail
            'hypothesis',  # the paper's lemmas are properties
            'catkin_pkg',  # reads package.xml
            'jsonschema',  # holds parameter files against the schema that editors get
            # finds the same errors in what a replay writes; GPL, so only run as a program
            'evo; python_version >= "3.11"',
            'threadpoolctl',  # counts the threads that numpy takes
        ],
        'dev': [
            'pytest-xdist',  # tests that wait for nodes leave time for others
            'ruff',
            'mypy',
            'types-PyYAML',
            'import-linter',  # holds the layers of the architecture
            'flake8',  # what ament_flake8 runs, with the plug-ins that it has on a ROS machine:
            'flake8-comprehensions',
            'flake8-import-order',
            'flake8-quotes',
            'pydocstyle',  # what ament_pep257 runs
            'colcon-common-extensions',
            'setuptools<80',  # later ones break colcon's --symlink-install
        ],
        'benchmark': ['gtsam'],
        'docs': ['mkdocs', 'mkdocs-material'],
    },
    entry_points={
        'console_scripts': [
            f'slam-observer = {PACKAGE}.cli.main:main',
            f'observer_node = {PACKAGE}.nodes.executables:observer_node',
            f'lifecycle_observer_node = {PACKAGE}.nodes.executables:lifecycle_observer_node',
            f'simulator_node = {PACKAGE}.nodes.executables:simulator_node',
        ],
    },
)
