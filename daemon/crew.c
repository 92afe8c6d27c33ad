/* Threads that share the patches of a dirty set.
 *
 * Everyone, the caller too, takes the next index from one counter until there is none; results land at their index, so
 * their order is that of the keys whoever made them (law L2). Helpers sleep between tasks. Small sets are not worth
 * waking anybody: a wake-up costs about as much as a patch. */
#include "daemon/crew.h"

#include <pthread.h>
#include <stdlib.h>
#include <unistd.h>

#define ALONE_MAX 3 /* patches the caller meshes by itself */

struct helper {
	struct crew *crew;
	struct mesher *mesher;
	pthread_t thread;
};

struct crew {
	struct mesher *mesher; /* the caller's */
	struct helper helper[CREW_THREADS_MAX - 1];
	int helpers;
	atomic_size_t next; /* of the task's keys */

	pthread_mutex_t lock;
	pthread_cond_t begin, end;
	/* Under `lock`; the task itself is constant while helpers are busy. */
	const struct crew_task *task;
	uint64_t number; /* of tasks so far */
	int busy;
	bool stop;
};

static void work(struct crew *crew, const struct crew_task *task, struct mesher *mesher)
{
	size_t i;

	while (!atomic_load(task->stop) && (i = atomic_fetch_add(&crew->next, 1)) < task->n) {
		task->patch[i] = map_mesh_patch(task->map, mesher, task->key[i], &task->faces_raw[i]);
		atomic_fetch_add_explicit(task->progress, 1, memory_order_relaxed);
	}
}

static void *run(void *ctx)
{
	struct helper *helper = ctx;
	struct crew *crew = helper->crew;
	uint64_t done = 0;

	pthread_mutex_lock(&crew->lock);
	for (;;) {
		const struct crew_task *task;

		while (!crew->stop && crew->number == done)
			pthread_cond_wait(&crew->begin, &crew->lock);
		if (crew->stop)
			break;
		done = crew->number;
		task = crew->task;
		pthread_mutex_unlock(&crew->lock);
		work(crew, task, helper->mesher);
		pthread_mutex_lock(&crew->lock);
		if (--crew->busy == 0)
			pthread_cond_signal(&crew->end);
	}
	pthread_mutex_unlock(&crew->lock);
	return NULL;
}

void crew_mesh(struct crew *crew, const struct crew_task *task)
{
	bool together = crew->helpers > 0 && task->n > ALONE_MAX;

	atomic_store(&crew->next, 0);
	if (together) {
		pthread_mutex_lock(&crew->lock);
		crew->task = task;
		crew->number++;
		crew->busy = crew->helpers;
		pthread_cond_broadcast(&crew->begin);
		pthread_mutex_unlock(&crew->lock);
	}
	work(crew, task, crew->mesher);
	if (together) {
		pthread_mutex_lock(&crew->lock);
		while (crew->busy > 0)
			pthread_cond_wait(&crew->end, &crew->lock);
		pthread_mutex_unlock(&crew->lock);
	}
}

static int choose_threads(int threads)
{
	if (threads <= 0)
		threads = (int)sysconf(_SC_NPROCESSORS_ONLN);
	if (threads > CREW_THREADS_MAX)
		threads = CREW_THREADS_MAX;
	return threads < 1 ? 1 : threads;
}

static void hire(struct crew *crew, int helpers)
{
	while (crew->helpers < helpers) {
		struct helper *helper = &crew->helper[crew->helpers];

		helper->crew = crew;
		helper->mesher = mesher_create();
		if (!helper->mesher || pthread_create(&helper->thread, NULL, run, helper) != 0) {
			mesher_destroy(helper->mesher);
			return;
		}
		crew->helpers++;
	}
}

struct crew *crew_create(int threads)
{
	struct crew *crew = calloc(1, sizeof(*crew));

	if (!crew)
		return NULL;
	crew->mesher = mesher_create();
	if (!crew->mesher) {
		free(crew);
		return NULL;
	}
	pthread_mutex_init(&crew->lock, NULL);
	pthread_cond_init(&crew->begin, NULL);
	pthread_cond_init(&crew->end, NULL);
	hire(crew, choose_threads(threads) - 1);
	return crew;
}

void crew_destroy(struct crew *crew)
{
	if (!crew)
		return;
	pthread_mutex_lock(&crew->lock);
	crew->stop = true;
	pthread_cond_broadcast(&crew->begin);
	pthread_mutex_unlock(&crew->lock);
	for (int i = 0; i < crew->helpers; i++) {
		pthread_join(crew->helper[i].thread, NULL);
		mesher_destroy(crew->helper[i].mesher);
	}
	pthread_cond_destroy(&crew->end);
	pthread_cond_destroy(&crew->begin);
	pthread_mutex_destroy(&crew->lock);
	mesher_destroy(crew->mesher);
	free(crew);
}
