from cleargs.api import evaluate_scene as evaluate_scene
from cleargs.api import export as export
from cleargs.api import film as film
from cleargs.api import run as run
from cleargs.api import write_report as write_report
from cleargs.api_images import deblur as deblur
from cleargs.api_images import restore as restore
from cleargs.api_images import score as score
from cleargs.api_images import score_frames as score_frames
from cleargs.api_scenes import initialise as initialise
from cleargs.api_scenes import load as load
from cleargs.api_scenes import render_view as render_view
from cleargs.api_scenes import save as save
from cleargs.api_scenes import train as train
from cleargs.errors import CleargsError as CleargsError
from cleargs.run_results import Prepared as Prepared
from cleargs.run_results import Run as Run
from cleargs.run_results import StageResults as StageResults
from cleargs.run_results import open_prepared as open_prepared
from cleargs.run_results import open_run as open_run
from cleargs.scene.config import G0Config as G0Config
from cleargs.splat.camera import Camera as Camera
from cleargs.splat.config import TrainConfig as TrainConfig
from cleargs.splat.gaussians import Gaussians as Gaussians
from cleargs.splat.scene import Scene as Scene
from cleargs.splat.views import TrainingView as TrainingView
from cleargs.synth.synthetic_capture import make_capture as make_capture

__all__: list[str]
__version__: str
