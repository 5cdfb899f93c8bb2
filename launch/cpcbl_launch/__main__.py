from cpcbl_launch.cli import main

main()
