"""Play a bag into the node: ros2 launch csgm_ros replay.launch.py bag:=BAG source_topic:=/map target_topic:=/points.

Takes every argument of csgm.launch.py as well. The topics are those recorded; time is the bag's.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription, OpaqueFunction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def arguments() -> list[DeclareLaunchArgument]:
    """Return what replaying adds."""
    return [
        DeclareLaunchArgument('bag', description='folder of the rosbag2 bag'),
        DeclareLaunchArgument('rate', default_value='1.0', description='bag seconds per second'),
        DeclareLaunchArgument('loop', default_value='false', description='start again', choices=['true', 'false']),
        DeclareLaunchArgument(
            'player', default_value='csgm', description='csgm replay, or ros2 bag play', choices=['csgm', 'ros2']
        ),
    ]


def player(context: LaunchContext) -> list:
    """Return the process that plays the bag."""
    chosen, bag, rate, loop = (LaunchConfiguration(name).perform(context) for name in ('player', 'bag', 'rate', 'loop'))
    again = ['--loop'] if loop == 'true' else []
    if chosen == 'ros2':
        command = ['ros2', 'bag', 'play', bag, '--clock', '--rate', rate, *again]
        return [ExecuteProcess(cmd=command, output='screen')]
    return [
        Node(
            package='csgm_ros',
            executable='csgm',
            arguments=['replay', bag, '--rate', rate, *again],
            output='screen',
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """Return the node on simulated time, registering the first pair by default, and the player."""
    inner = PathJoinSubstitution([FindPackageShare('csgm_ros'), 'launch', 'csgm.launch.py'])
    node = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(inner),
        launch_arguments={
            'use_sim_time': 'true',
            'trigger': LaunchConfiguration('trigger', default='on_first_pair'),
        }.items(),
    )
    return LaunchDescription([*arguments(), node, OpaqueFunction(function=player)])
