"""All six programs, for those who run them one after the other."""

from __future__ import annotations

import mapping
import particle_filter
import planning
import scan_localisation
import visual_map
import visual_odometry
from common import Program

PROGRAMS: dict[str, type[Program]] = {
    "mapping": mapping.Mapping,
    "visual_map": visual_map.VisualMapping,
    "visual_odometry": visual_odometry.Odometry,
    "planning": planning.Planning,
    "particle_filter": particle_filter.ParticleLocalisation,
    "scan_localisation": scan_localisation.ScanLocalisation,
}
