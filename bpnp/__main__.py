from bpnp.cli import main

main()
