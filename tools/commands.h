/* The commands of `facet`: each takes the rest of the command line, argv[0] being "facet NAME", and answers with the exit
 * status: 0, 1 bad input, 2 bad usage. */
#ifndef FACET_TOOLS_COMMANDS_H
#define FACET_TOOLS_COMMANDS_H

int reconstruct_main(int argc, char **argv);
int watch_main(int argc, char **argv);
int save_main(int argc, char **argv);
int simulate_main(int argc, char **argv);
int picture_main(int argc, char **argv);
int record_main(int argc, char **argv);
int info_main(int argc, char **argv);
int repair_main(int argc, char **argv);
int replay_main(int argc, char **argv);
int devices_main(int argc, char **argv);

#endif
