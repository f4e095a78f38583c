from neuroslam import record
from neuroslam.worlds.animal_tracks import read_animal_track
from neuroslam.worlds.senses import ArenaSource

walk = read_animal_track("rat.csv", columns={"x": "px", "y": "py"}, units="cm,ms", arena="square")
log = record(ArenaSource(walk))
