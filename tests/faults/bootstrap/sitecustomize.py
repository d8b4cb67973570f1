"""Python runs this at every start with this folder on PYTHONPATH: in a child process, too."""

import fault_boot_id
import fault_clock
import fault_orphan
import fault_recorder

fault_boot_id.install_from_environment()
fault_clock.install_from_environment()
fault_orphan.install_from_environment()
fault_recorder.install_from_environment()
