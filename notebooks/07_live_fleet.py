# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # One live map for a fleet
# Three robots drive around a rendered gallery, each a part of it. Each maps by itself, and offers its new places to a
# shared map, a single SQLite file. The map of all is computed from the *set* of offers: it does not depend on the
# order in which they arrive. A fourth robot has wrong odometry; a fifth drives in another building. Neither may
# spoil the map. The page [live map](../docs/live_map.md) has the commands and the figures that were measured.

# %%
# %matplotlib inline
import random
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch

from neuroslam import BrainConfig, NavigationBrain, open_source
from neuroslam.figures.maps import contact_sheet
from neuroslam.figures.style import SESSIONS, STYLE
from neuroslam.shared_map import Journal, LiveRobot, decode, encode, fold
from neuroslam.shared_map.fold import gather, publication

torch.set_num_threads(1)
plt.rcParams.update(STYLE | {"figure.constrained_layout.use": True, "figure.dpi": 100})
config = BrainConfig()
RING = "world:ellipse?noise=0.01&width=128&height=32&frames_per_lap=200"
SOURCES = {
    "ada": f"{RING}&laps=0.5&start=0.0",
    "bob": f"{RING}&laps=0.5&start=0.25&seed=1",
    "eve": f"{RING}&laps=0.5&start=0.5&seed=2",
    "wrong": f"{RING}&laps=0.5&start=0.1&seed=3",
    "stranger": f"{RING}&laps=0.3&seed=4&look=5",
}
COLOUR = dict(zip(SOURCES, SESSIONS, strict=False))
frames = {name: list(open_source(source).frames()) for name, source in SOURCES.items()}
frames["wrong"] = [
    frame._replace(velocity=frame.velocity._replace(v_m_s=2.0 * frame.velocity.v_m_s))
    for frame in frames["wrong"]
]
print({name: len(each) for name, each in frames.items()}, "frames")

# %% [markdown]
# **What to see:** the true paths of the robots in the gallery. Ada shares a quarter of the
# ring with Bob, and Bob another with Eve; the stranger drives in another building of the same shape.

# %%
for name, each in frames.items():
    truth = np.array([frame.truth for frame in each])
    shift = 0.25 * list(SOURCES).index(name)
    plt.plot(
        truth[:, 0] * (1 + 0.02 * shift),
        truth[:, 1] * (1 + 0.08 * shift),
        color=COLOUR[name],
        lw=3,
        label=name,
    )
plt.gca().set(
    xlabel="x (m)", ylabel="y (m)", title="True paths, drawn beside each other", aspect="equal"
)
plt.legend(loc="center")
plt.show()

# %% [markdown]
# ## Offers
# A robot's brain is an ordinary `NavigationBrain`. `LiveRobot` watches it: `offer()` sends what is new since the last
# acknowledged offer. The receipt comes once the offer is on the disk.

# %%
folder = Path(tempfile.mkdtemp())
brains, sizes = {}, {}
journal = Journal(folder, config)
for name, each in frames.items():
    brain = brains[name] = NavigationBrain(config)
    robot = LiveRobot(journal, brain, name)
    for frame in each:
        brain(frame)
        if frame.index % 10 == 9:
            robot.offer()
    robot.offer()
    sizes[name] = (robot.n_offered, robot.sent_bytes)
    print(
        f"{name}: {robot.n_offered} places, {robot.sent_bytes / robot.n_offered:.0f} bytes a place"
    )
entries = journal.all()
offer = decode(entries[0].message)
print(
    f"the first offer has {len(entries[0].message)} bytes: {len(offer.places)} places, {len(offer.links)} links"
)

# %% [markdown]
# **What to see:** bytes for a place, 500 to 600 for templates of 60 x 10 pixels; 1000 places take about half a
# megabyte. Most of it are the templates themselves, which do not compress well.

# %%
plt.bar(
    list(sizes), [sent / n for n, sent in sizes.values()], color=[COLOUR[name] for name in sizes]
)
plt.gca().set(ylabel="bytes a place", title="What a place costs to send")
plt.show()

# %% [markdown]
# **What to see:** templates of the first offer, as others receive them.

# %%
width, height = config.view.template_width, config.view.template_height
views = [row.reshape(width, height).T for row in offer.pixels]
contact_sheet(views, [f"place {k}" for k in range(len(views))])

# %% [markdown]
# **What to see:** each robot has a map of its own, in its own coordinates. That of the robot with wrong odometry is
# twice as large.

# %%
figure, panels = plt.subplots(1, 5, figsize=(11, 2.6), sharex=True, sharey=True)
for panel, (name, brain) in zip(panels, brains.items(), strict=True):
    panel.plot(*brain.map.poses[:, :2].T, ".", color=COLOUR[name], ms=4)
    panel.set(title=name, xlabel="x (m)", aspect="equal")
panels[0].set_ylabel("y (m)")
plt.show()

# %% [markdown]
# ## The fold
# `fold` builds each robot's map from the offers, matches them, merges those whose odometry agrees on the common path,
# and leaves the rest in quarantine with a reason.

# %%
records = gather(entries)
folded = fold(records, config)
print("on the map:", ", ".join(folded.robots))
for row in folded.quarantine:
    print(f"in quarantine: {row['robot']}: {row['reason'][:150]}")

# %% [markdown]
# **What to see:** the shared map. Three parts of the ring have become one ring; where two robots have been, their
# experiences are one, and have the colour of the robot whose map was larger.

# %%
shared = folded.brain.map
owner = [records.robots[session] for session in shared.experiences.array("session").tolist()]
plt.scatter(*shared.poses[:, :2].T, s=14, c=[COLOUR[name] for name in owner])
for name in folded.robots:
    plt.scatter([], [], c=COLOUR[name], label=name)
plt.gca().set(
    xlabel="x (m)",
    ylabel="y (m)",
    title=f"Shared map of {len(folded.robots)} robots: {shared.n} experiences",
    aspect="equal",
)
plt.legend(loc="center")
plt.show()

# %% [markdown]
# ## The order of arrival does not matter
# Offers may come late, twice, or from a robot that was out of reach for an hour. The map is a function of their set.

# %%
shuffled = [*entries, *entries[::3]]
random.Random(0).shuffle(shuffled)
again = fold(gather(shuffled), config)
state, same = folded.brain.state_dict(), again.brain.state_dict()
print("equal to the last bit:", all(torch.equal(state[name], same[name]) for name in state))

# %% [markdown]
# **What to see:** the map after every fifth offer, in the order of arrival. Ada's map is alone first; Bob's and Eve's
# places join it once they are confirmed. The wrong robot and the stranger, who come last, add nothing.

# %%
sizes_so_far, robots_so_far = [], []
steps = range(5, len(entries) + 1, 5)
for k in steps:
    part = fold(gather(entries[:k]), config)
    sizes_so_far.append(0 if part.brain is None else part.brain.map.n)
    robots_so_far.append(len(part.robots))
plt.step(steps, sizes_so_far, where="post", label="experiences of the map")
plt.step(steps, [20 * n for n in robots_so_far], where="post", label="robots on the map (x 20)")
plt.gca().set(xlabel="offers in the journal", ylabel="count", title="The map grows with the offers")
plt.legend()
plt.show()

# %% [markdown]
# ## Places of other robots
# Once a fold is published, every robot can take it: `take` reads what is new, `recognise` compares a picture with all
# places, `pose` is the robot's own pose on the shared map.

# %%
journal.publish(publication(folded, entries[-1].number))
robot = LiveRobot(journal, brains["ada"])
print(robot.take(), "places are usable by", robot.name)
print("Ada is at", [round(value, 2) for value in robot.pose])
seen = [(frame.truth, robot.recognise(frame.image)) for frame in frames["eve"][::4]]
print(
    f"{sum(found is not None for _, found in seen)} of {len(seen)} pictures of Eve are recognised by Ada"
)

# %% [markdown]
# **What to see:** where Ada, on the shared map, recognises Eve's pictures, most of them of places where Ada has never
# been; colours say which robot made the place.

# %%
plt.scatter(*shared.poses[:, :2].T, s=6, c="#c9c9c9")
for _, found in seen:
    if found is not None:
        plt.scatter(found.pose.x_m, found.pose.y_m, s=40, color=COLOUR[found.robot])
plt.gca().set(
    xlabel="x (m)", ylabel="y (m)", title="Eve's pictures, recognised by Ada", aspect="equal"
)
plt.show()

# %% [markdown]
# A new place is usable before the next fold: Eve offers one more, and it lies where its link puts it.
#
# **What to see:** the places that Ada knows, before (grey) and after (red) one more offer of Eve.

# %%
before = robot.placed
eve = brains["eve"]
moving = LiveRobot(journal, eve)
moving.take()
for frame in open_source(SOURCES["eve"].replace("laps=0.5", "laps=0.62")).frames(start=101):
    eve(frame)
receipts = moving.offer()
robot.take()
new = robot.placed - before
known = robot.map
keys = list(
    zip(
        known.map.experiences.array("session").tolist(),
        known.map.experiences.array("number").tolist(),
        strict=True,
    )
)
fresh = np.array([key in new for key in keys])
plt.scatter(*known.map.poses[~fresh, :2].T, s=8, c="#c9c9c9")
plt.scatter(*known.map.poses[fresh, :2].T, s=24, c="#DD1122")
plt.gca().set(
    xlabel="x (m)",
    ylabel="y (m)",
    title=f"{len(new)} new places of Eve, before the next fold",
    aspect="equal",
)
plt.show()

# %% [markdown]
# ## Messages are checked
# A message is bounded and holds no code. One wrong bit is noticed.

# %%
message = bytearray(encode(offer))
message[len(message) // 2] ^= 1
try:
    decode(bytes(message))
except ValueError as error:
    print(error)
journal.close()
