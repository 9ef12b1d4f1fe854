"""Camera `tactile_sr` of LeRobot: patterns, taxels and wrenches of a tactile sensor."""

from lerobot_camera_tactile_sr.tactile_sr_camera import TactileSrCamera, TactileSrCameraConfig

__all__ = ["TactileSrCamera", "TactileSrCameraConfig"]
