"""A wheel carries the C++ of ``native/``, so that ``pdal-stages plugin --install`` works wherever the package is."""

from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py


class WithNative(build_py):
    """Copy the sources of the PDAL plugin into the package; an editable install finds them in the checkout."""

    def run(self) -> None:
        """Build as ever, then copy."""
        super().run()
        if not self.editable_mode:
            for source in sorted(Path("native").glob("*.cpp")):
                target = Path(self.build_lib, "pdal_stages", "native", source.name)
                self.mkpath(str(target.parent))
                self.copy_file(str(source), str(target))


setup(cmdclass={"build_py": WithNative})
