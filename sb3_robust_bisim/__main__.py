from sb3_robust_bisim.cli.zoo import main

if __name__ == "__main__":
    main(program="python -m sb3_robust_bisim")
