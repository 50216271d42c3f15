"""Run ClearGS in a separate process, next to LichtFeld Studio."""

import subprocess
import threading
from pathlib import Path


class Job:
    """The commands that turn a video, a folder of images or a run into a data set.

    ``line`` is the last line that ClearGS printed. At the end, ``folder`` is the data set, or ``error`` says
    why there is none.
    """

    def __init__(self, program, source, repeat=1, deblurred=False):
        self.line, self.error, self.folder, self._process = "starting", None, None, None
        source = Path(source)
        run = source if (source / "run.toml").is_file() else source.with_name(f"{source.stem}-frames")
        target = run.with_name(f"{run.name}-data")
        export = [program, "export", str(run), "--capture", str(target), "--repeat", str(repeat)]
        until = "g0" if deblurred else "rva"
        self._commands = [[*export, "--deblurred"] if deblurred else export]
        if run != source:
            self._commands.insert(0, [program, "run", str(source), "-o", str(run), "--until", until])
        self._target = target
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    @property
    def running(self):
        return self._thread.is_alive()

    def stop(self):
        """Interrupt ClearGS. The same data set again continues from there."""
        if self._process is not None:
            self._process.terminate()

    def join(self):
        self._thread.join()

    def _work(self):
        try:
            for command in self._commands:
                self._process = subprocess.Popen(
                    command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace"
                )
                lines = []
                for line in self._process.stdout:
                    if line.strip():
                        lines.append(line.strip())
                        self.line = lines[-1]
                if self._process.wait() != 0:
                    cause = [line for line in lines if line.startswith(("error:", "hint:"))]
                    self.error = "\n".join(cause or lines[-1:] or ["ClearGS stopped"])
                    return
            self.folder = str(self._target)
        except OSError as error:
            self.error = f"{command[0]} cannot be started: {error}"
