from neuroslam import BrainConfig, NavigationBrain, load_brain, open_source, save_brain

brain = NavigationBrain(BrainConfig())
for frame in open_source("world:corridor?laps=2&noise=0.05").frames(stop=400):
    result = brain(frame)
    if result.action == "link":
        print(f"frame {result.frame}: loop closed at experience {result.experience}")
print(brain.map.n, "experiences,", brain.map.n_links, "links; the robot is at", brain.map.pose)
print("path to experience 10:", brain.map.plan(10).path)
save_brain(brain, "brain.safetensors")
brain = load_brain("brain.safetensors")
