from neuroslam import load_brain

brain = load_brain("both/brain.safetensors")
brain.map.add_goal(12)
brain.map.add_goal(3, timeout_s=60.0)  # dropped after a minute
print("next:", brain.map.next_waypoint())
for goal, plan in brain.map.plans():
    print(goal, plan.path or plan.reason)
