from sb3_robust_bisim.cli.zoo import shell

if __name__ == "__main__":
    shell(program="python -m sb3_robust_bisim")
