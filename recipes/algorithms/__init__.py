"""Algorithms beside PPO, which is in training/ppo.py; each conf/algo entry names one."""
