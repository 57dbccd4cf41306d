from sb3_robust_bisim.zoo import main

if __name__ == "__main__":
    main()
