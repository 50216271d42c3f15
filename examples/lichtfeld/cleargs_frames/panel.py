"""The tab *ClearGS*: choose a video, and open its frames as a data set."""

import lichtfeld as lf

from .job import Job


class FramesPanel(lf.ui.Panel):
    """The tab, with its fields and its buttons."""

    id = "cleargs_frames.panel"
    label = "ClearGS"
    space = lf.ui.PanelSpace.MAIN_PANEL_TAB
    order = 200

    def __init__(self):
        self._program, self._source = "cleargs", ""
        self._repeat, self._deblurred = 1, False
        self._job = None

    def draw(self, ui):
        _, self._program = ui.input_text("Program", self._program)
        _, self._source = ui.path_input("Video", self._source, folder_mode=False)
        ui.text_disabled("A video, a folder of images, or a run of ClearGS")
        _, self._repeat = ui.slider_int("Copies of the best frames", self._repeat, 1, 5)
        _, self._deblurred = ui.checkbox("Deblurred frames (trains a scene first)", self._deblurred)
        if self._job is not None and self._job.running:
            ui.text_wrapped(self._job.line)
            if ui.button("Stop"):
                self._job.stop()
            return
        if ui.button_styled("Prepare and open", "primary") and self._source.strip():
            self._job = Job(self._program, self._source.strip(), self._repeat, self._deblurred)
            return
        if self._job is None:
            return
        if self._job.error:
            ui.text_wrapped(self._job.error)
        elif self._job.folder:
            folder, self._job = self._job.folder, None
            lf.log.info(f"ClearGS: {folder}")
            lf.load_file(folder, is_dataset=True)  # in draw, which the main thread calls
